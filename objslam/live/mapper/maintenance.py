"""What a map needs now and then: duplicates merged, ghosts dropped, a second look at every ray, bounded growth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.association.observations import Observations
from objslam.association.place_recognition import label_densities
from objslam.association.refinement import normalised_residuals
from objslam.association.single_object_fit import fit_point
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint
from objslam.core.statistics import MOST_NOISE_FACTOR, OUTLIER_RAY, SAME_POINT, noise_factors
from objslam.errors import SolveError
from objslam.live.mapper.keyframe_culling import cull_keyframes
from objslam.live.mapper.landmark_table import covariances, in_view, noise
from objslam.live.mapper.landmark_update import merge_landmarks, remove_landmarks
from objslam.live.mapper.loop_closure import close_loop
from objslam.live.mapper.pose_uncertainty import carried, gathered
from objslam.live.mapper.state import MapState
from objslam.live.mapper.track_promotion import AGREE, SLACK, fit_if_observable
from objslam.mapping.alternation import MANY, SECOND

_EVERY = 10
"""Keyframes after which each duty is due again; larger leaves duplicates and false landmarks in the map for longer."""
_GROWING = 3
"""Place of the duties that bound growth among those keyframes; not that of the others, so that no frame pays for two."""
_CLOSING = 6
"""Place of the duties that merge and drop landmarks."""
_BREATH = 2
"""Keyframes after which variables that moved are looked for, when a loop has closed; larger lets the map settle later."""
_FIRST = 20
"""Keyframes after which the graph is solved as a whole for the first time; fewer tell too little of any landmark."""
_GROWTH = 1.5
"""Times more keyframes until it is solved as a whole again; larger leaves what the first guesses got wrong for longer."""
_ITERATIONS = 8
"""Iterations of such a solve at the most; more take longer, for which a frame has to wait."""
_LARGE = 400
"""Keyframes above which the graph is not solved but linearised again, step by step, for no frame may wait for a solve."""
_ODDS = 2.5
"""Log odds that two landmarks are one, against another one that happens to stand there; larger leaves more duplicates."""
_HALF = 0.5
"""Share of a landmark's rays; where fewer fit, its place is looked for among all of them. Larger does so more often."""
_VISITS = 6
"""Changes between rays that fit a label's object and rays that do not, at the least, where there are two objects; a drifted
path, or a bad place, disagrees at one stretch."""
_DISTANT = 60.0
"""s; how long a track of enough rays, which something seen from afar has, is waited for. Larger keeps more tracks."""
_AROUND = 0.15
"""Share of the image around it; what stands there may soon be in it. Larger prepares the graph for more landmarks."""
_USUAL = 0.75
"""Quantile of the distances from which landmarks were seen; what is no further away may soon be seen."""


def maintain(m: MapState) -> None:
    """After each keyframe, whatever is due."""
    m.graph.continue_rebuild()
    number, schedule = m.next_id.keyframe, m.schedule
    due = number % _EVERY == 0 or (schedule.relinearisations > 0 and number % _BREATH == 0)
    relinearise = due and not m.graph.is_rebuilding  # A rebuilt graph is linearised at the estimate of now.
    if relinearise:
        schedule.relinearisations = max(0, schedule.relinearisations - 1)
    m.graph.prepare(_coming(m), relinearise)
    if number % _EVERY == _GROWING:
        _do(m, (_forget_tracks, cull_keyframes, _polish_if_grown))
    elif number % _EVERY == _CLOSING and not m.by_label:
        _do(m, (close_loop, _merge_duplicates, _drop_ghosts))


def _coming(m: MapState) -> Ints:
    """The landmarks (n,) that the camera of the newest keyframe shows, or soon may."""
    landmarks, keyframes = m.landmarks, m.keyframes
    if not len(landmarks.id):
        return landmarks.id
    pose, camera = m.graph.pose(int(keyframes.id[-1])), m.cameras[keyframes.camera[-1]]
    reach = float(np.quantile(landmarks.far, _USUAL))
    return np.asarray(landmarks.id[in_view(landmarks, camera, pose, -_AROUND, reach)])


def _do(m: MapState, duties: tuple[Callable[[MapState], None], ...]) -> None:
    """One duty after the other, until one has the graph built again in turns."""
    m.read_positions()
    for duty in duties:
        if not m.graph.is_rebuilding:
            duty(m)


def _polish_if_grown(m: MapState) -> None:
    if m.next_id.keyframe >= max(_FIRST, _GROWTH * m.schedule.solved) and len(m.landmarks):
        m.schedule.solved = m.next_id.keyframe
        polish(m)


def polish(m: MapState) -> None:
    """The whole graph solved by Levenberg-Marquardt, then every ray asked again whether it fits its landmark.

    A large graph is linearised again instead, in turns.
    """
    large = len(m.keyframes) > _LARGE
    try:
        if not large:
            m.graph.solve(_ITERATIONS)
    except SolveError:
        m.counters.accept("solves given up")
    if _reconsider(m) or large:
        m.graph.rebuild_in_slices(m.in_order())
    m.read_positions()


def _reconsider(m: MapState) -> bool:
    """Reject rays that miss their landmark by far more than its others, take back those that do not; whether any changed."""
    rays, landmarks = m.rays, m.landmarks
    m.graph.refresh()
    m.read_positions()
    held = np.flatnonzero(rays.owner >= 0)
    if not len(held):
        return False
    row = m.rows_of(rays.owner[held])
    obs = m.sight(held)
    off = normalised_residuals(obs, landmarks.position[row])
    before = rays.used[held] & np.isfinite(off)
    noise_factor = np.minimum(noise_factors(off[before], row[before], len(landmarks)), MOST_NOISE_FACTOR)
    support: Bools = off <= OUTLIER_RAY * noise_factor[row]
    if m.by_label:
        number, fits = np.bincount(row, minlength=len(landmarks)), np.bincount(row[support], minlength=len(landmarks))
        if m.settings.association.method == "auto" and _two_of_a_label(m, obs, row, support):
            m.tell_apart_within_labels()
        for j in np.flatnonzero((fits < _HALF * number) & (number >= MANY)).tolist():
            mine = np.flatnonzero(row == j)
            fit = fit_point(obs.take(mine), m.rng, SLACK)
            if fit is not None and fit.inlier.sum() > fits[j]:
                landmarks.position[j] = fit.position
                m.graph.place(int(landmarks.id[j]), fit.position)
                support[mine] = fit.inlier
    out, back = held[rays.used[held] & ~support], held[~rays.used[held] & support]
    rays.used[held] = support
    m.graph.drop_rays(rays.number[out])
    if len(back):
        m.graph.add_rays(m.bearings(back))
    return bool(len(out) or len(back))


def _two_of_a_label(m: MapState, obs: Observations, row: Ints, support: Bools) -> bool:
    """Whether the rays (R,), in the order of time, show that some label has two objects.

    Many disagree with the one that it has, in turns with those that do not, and would make another one by themselves.
    """
    against = np.bincount(row[~support], minlength=len(m.landmarks))
    number = np.bincount(row, minlength=len(m.landmarks))
    for j in np.flatnonzero((against >= MANY) & (against > SECOND * number)).tolist():
        mine = np.flatnonzero(row == j)
        if (np.diff(support[mine].astype(np.int64)) != 0).sum() < _VISITS:
            continue
        other = obs.take(mine[~support[mine]])
        if fit_if_observable(other, MANY, AGREE, m.settings, m.rng) is not None:
            return True
    return False


def _forget_tracks(m: MapState) -> None:
    """Give up tracks out of sight for too long."""
    now, live = float(m.keyframes.stamp.max()), m.settings.live
    waits = (live.forget, _DISTANT)
    m.tracks = [t for t in m.tracks if t.by_label or now - t.last < waits[len(t.rays) >= live.min_rays]]


def _merge_duplicates(m: MapState) -> None:
    """Landmarks of one label that are no further apart than the graph allows, and were not seen in one frame, are one.

    As `alternation.merge_unseen_together` does for a log, but by bounds on the covariances, which take no time. Bounds that
    are wide would take neighbours for one, so the odds against a neighbour count too.
    """
    landmarks = m.landmarks
    if len(landmarks) < 2:
        return
    a, b, apart = near_pairs(landmarks.position, landmarks.label, m.settings.association.duplicate_distance)
    density = label_densities(landmarks.position, landmarks.label)
    gone: set[int] = set()
    for i, j, way in zip(a.tolist(), b.tolist(), apart, strict=True):
        ids = int(landmarks.id[i]), int(landmarks.id[j])
        fewer = min(int(landmarks.seen[i]), int(landmarks.seen[j]))
        if gone & {i, j} or seen_as_two(m.pairs.together.get(ids, 0), fewer):
            continue
        if m.pairs.apart.get(ids) == fewer // 5:  # nothing new since they were found to be two
            continue
        rows = np.array([i, j])
        spread = (covariances(landmarks, rows) * (noise(landmarks, rows) ** 2)[:, None, None]).sum(axis=0) + _drifted(
            m, rows
        )
        if not np.isfinite(spread).all() or not _one(way, spread, density[i]):
            m.pairs.apart[ids] = fewer // 5
            continue
        keep, drop = (i, j) if landmarks.seen[i] >= landmarks.seen[j] else (j, i)
        gone.add(drop)
        merge_landmarks(m, keep, drop)
    if gone:
        m.counters.accept("merged objects", len(gone))
        remove_landmarks(m, np.array(sorted(gone)))


def _one(way: Floats, spread: Floats, density: float) -> bool:
    """Whether two landmarks `way` (3,) m apart are one: by the covariance (3, 3) of that, and by how many of their label
    there are per m^2, one of which may stand there as well."""
    squared = float(way @ np.linalg.solve(spread, way))
    area = 2 * np.pi * np.sqrt(np.linalg.det(spread[:2, :2]))
    return squared <= SAME_POINT and -np.log(area * density) - squared / 2 >= _ODDS


def _drifted(m: MapState, rows: Ints) -> Floats:
    """Covariance (3, 3) of two landmarks' places to each other by how the path drifted between their last sightings.

    Or by how little the newest pose is known, if that is less: both bound what the graph knows, which takes too long to ask.
    """
    k, landmarks = m.keyframes, m.landmarks
    newest = int(np.argmax(k.stamp))
    pose = m.graph.pose(int(k.id[newest]))
    first, second = rows[np.argsort(landmarks.last[rows], kind="stable")]
    to = (landmarks.position[rows].mean(axis=0) - pose[:3, 3])[None]
    camera_from_drift = adjoint(k.camera_T_start[newest])
    gained = camera_from_drift @ gathered(landmarks.drift[second], landmarks.drift[first][None]) @ camera_from_drift.T
    since = carried(to, gained, pose)[0]
    if not np.isfinite(m.pose_covariance).all():
        return since
    placed = carried(to, m.pose_covariance, pose)[0]
    return placed if np.trace(placed) < np.trace(since) else since


def _drop_ghosts(m: MapState) -> None:
    """Landmarks that are hardly ever seen where they should be."""
    landmarks, live = m.landmarks, m.settings.live
    rarely_seen = landmarks.seen < live.ghost_share * landmarks.expected
    ghost = np.flatnonzero((landmarks.expected >= live.ghost_frames) & rarely_seen)
    if len(ghost):
        m.counters.accept("ghosts dropped", len(ghost))
        mine = np.isin(m.rays.owner, landmarks.id[ghost])
        m.graph.drop_rays(m.rays.number[mine])
        m.rays.owner[mine], m.rays.used[mine] = -1, False
        remove_landmarks(m, ghost)
