"""What a map needs now and then: duplicates merged, ghosts dropped, a second look at every ray, bounded growth."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.constellation import densities
from objslam.association.extent import grouped_median
from objslam.association.sightings import Sightings
from objslam.errors import SolveError
from objslam.geometry import adjoint, inverse
from objslam.live.candidates import carried_place
from objslam.live.joining import join, without
from objslam.live.known import carried, covariances, gathered, in_view, noise
from objslam.live.loops import close_loop
from objslam.live.meeting import meet, misses
from objslam.live.thinning import thin_if_many
from objslam.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_EVERY = 10  # keyframes
_GROWING, _CLOSING = 3, 6  # of these; what is due does not come all at once, for no frame may wait for long
_TURNS, _BREATH = 3, 2  # updates that the graph is given when a loop has closed, and at every which keyframe
_FIRST, _GROWTH = 20, 1.5  # keyframes; the graph is solved as a whole when there are so many, then so many times more
_ITERATIONS, _LARGE = 8, 400  # iterations, for so many keyframes at the most: no frame may wait for long
_MISS = 4.0  # standard deviations by which a ray may miss its landmark
_WIDEST = 5.0  # times the noise that was promised
_RAYLEIGH_MEDIAN = 1.1774
_SAME = 11.3  # squared Mahalanobis distance below which 99 % of equal points lie (chi-squared, 3 degrees of freedom)
_ODDS = 2.5  # log odds that two landmarks are one, against another one that happens to stand there
_FARTHEST = 1.0  # m; objects further apart are two, however little is known of them
_TOGETHER = 0.03  # share of frames with both that a wrong box may account for
_GHOST, _GHOST_FRAMES = 0.1, 40  # seen in a smaller share of so many frames that should show it, it is none
_HALF = 0.5  # of a landmark's rays; when fewer fit, it is looked for anew
_MANY, _SECOND = 5, 0.25  # rays, and share of them, that disagree with a label's one object if there is a second,
_VISITS = 6  # and so often it is one's turn after the other's: a drifted path, or a bad place, disagrees at one stretch
_AGREE = 0.7  # share of them that make another place
_DISTANT = 60.0  # s; how long something seen from afar is waited for
_SLACK = 0.02  # m
_AROUND = 0.15  # share of the image: what stands so close beside it may soon be in it,
_USUAL = 0.75  # and what is no further away than so many landmarks were seen from


def after_keyframe(m: Mapper) -> None:
    """Every few keyframes, whatever is due."""
    m.graph.take_turn()
    number = m.keyframes_so_far
    if m.unsettled:
        m.unsettled, m.unrest = False, _TURNS
    due = number % _EVERY == 0 or (m.unrest > 0 and number % _BREATH == 0)
    relinearise = due and not m.graph.in_turns  # what comes of turns is linearised where the estimate is now anyway
    if relinearise:
        m.unrest = max(0, m.unrest - 1)
    m.graph.prepare(_coming(m), relinearise)
    if number % _EVERY == _GROWING:
        _look_at(m, (_forget, thin_if_many, _polish_if_grown))
    elif number % _EVERY == _CLOSING and not m.by_label:
        _look_at(m, (close_loop, _merge, _drop_ghosts))


def _coming(m: Mapper) -> Ints:
    """The landmarks (n,) that the camera of the newest keyframe shows, or soon may."""
    newest = len(m.keyframes) - 1
    pose, camera = m.graph.pose(int(m.keyframes.id[newest])), m.cameras[int(m.keyframes.camera[newest])]
    reach = float(np.quantile(m.known.far, _USUAL)) if len(m.known) else 0.0
    return np.asarray(m.known.id[in_view(m.known, camera, pose, -_AROUND, reach)])


def _look_at(m: Mapper, tasks: tuple[Callable[[Mapper], None], ...]) -> None:
    """One task after the other, until one has the graph built anew in turns."""
    m.known.position[:] = m.graph.points(m.known.id)
    for task in tasks:
        if not m.graph.in_turns:
            task(m)


def _polish_if_grown(m: Mapper) -> None:
    if m.keyframes_so_far >= max(_FIRST, _GROWTH * m.polished) and len(m.known):
        m.polished = m.keyframes_so_far
        polish(m)


def polish(m: Mapper) -> None:
    """The whole graph solved by Levenberg-Marquardt, then every ray asked again whether it fits its landmark.

    A large graph is linearised anew instead, in turns.
    """
    large = len(m.keyframes) > _LARGE
    try:
        if not large:
            m.graph.solve(_ITERATIONS)
    except SolveError:
        m.counters.accept("solves given up")
    if _reconsider(m) or large:
        m.graph.rebuild_in_turns(m.in_order())
    m.known.position[:] = m.graph.points(m.known.id)


def _reconsider(m: Mapper) -> bool:
    """Reject rays that miss their landmark by far more than its others, take back those that do not; whether any changed."""
    rays, known = m.rays, m.known
    m.graph.refresh()
    known.position[:] = m.graph.points(known.id)
    held = np.flatnonzero(rays.owner >= 0)
    if not len(held):
        return False
    row = m.rows_of(rays.owner[held])
    s = m.sight(held)
    off = misses(s, known.position[row])
    support = _support(off, row, rays.used[held], len(known))
    if m.by_label:
        number, fits = np.bincount(row, minlength=len(known)), np.bincount(row[support], minlength=len(known))
        if m.settings.association.method == "auto" and _two_of_a_label(m, s, row, support):
            m.by_label = False
            m.candidates = [c for c in m.candidates if not c.by_label]
        for j in np.flatnonzero((fits < _HALF * number) & (number >= _MANY)).tolist():
            mine = np.flatnonzero(row == j)
            met = meet(s.take(mine), m.rng, _SLACK)
            if met is not None and met.agree.sum() > fits[j]:
                known.position[j] = met.position
                m.graph.place(int(known.id[j]), met.position)
                support[mine] = met.agree
    out, back = held[rays.used[held] & ~support], held[~rays.used[held] & support]
    rays.used[held] = support
    m.graph.drop_rays(rays.number[out])
    if len(back):
        m.graph.add_rays(m.bearings(back))
    return bool(len(out) or len(back))


def _two_of_a_label(m: Mapper, s: Sightings, row: Ints, support: Bools) -> bool:
    """Whether the rays (R,), in the order of time, show that some label has two objects.

    Many disagree with the one that it has, in turns with those that do not, and would make another one by themselves.
    """
    against = np.bincount(row[~support], minlength=len(m.known))
    number = np.bincount(row, minlength=len(m.known))
    for j in np.flatnonzero((against >= _MANY) & (against > _SECOND * number)).tolist():
        mine = np.flatnonzero(row == j)
        if (np.diff(support[mine].astype(np.int64)) != 0).sum() < _VISITS:
            continue
        other = s.take(mine[~support[mine]])
        if carried_place(other, _MANY, _AGREE, m.settings, m.rng) is not None:
            return True
    return False


def _support(off: Floats, row: Ints, used: Bools, count: int) -> Bools:
    """Which rays (R,) miss their landmark (R,) by no more than its others let expect; off: (R,) standard deviations."""
    before = used & np.isfinite(off)
    usual = np.nan_to_num(grouped_median(off[before], row[before], count)) / _RAYLEIGH_MEDIAN
    return np.asarray(off <= _MISS * np.clip(usual, 1.0, _WIDEST)[row])


def _forget(m: Mapper) -> None:
    """Candidates out of sight for too long."""
    now, live = float(m.keyframes.stamp.max()), m.settings.live
    m.candidates = [
        c for c in m.candidates if c.by_label or now - c.last < (_DISTANT if len(c) >= live.min_rays else live.forget)
    ]


def _merge(m: Mapper) -> None:
    """Landmarks of one label that are no further apart than the graph allows, and were not seen in one frame, are one."""
    known = m.known
    if len(known) < 2:
        return
    a, b = np.triu_indices(len(known), 1)
    apart = known.position[a] - known.position[b]
    near = (known.label[a] == known.label[b]) & (np.linalg.norm(apart, axis=1) < _FARTHEST)
    a, b, apart = a[near], b[near], apart[near]
    density = densities(known.position, known.label)
    gone: set[int] = set()
    for i, j, way in zip(a.tolist(), b.tolist(), apart, strict=True):
        ids = int(known.id[i]), int(known.id[j])
        fewer = min(int(known.seen[i]), int(known.seen[j]))
        if gone & {i, j} or m.together.get(ids, 0) > _TOGETHER * fewer:
            continue
        if m.apart.get(ids) == fewer // 5:  # nothing new since they were found to be two
            continue
        rows = np.array([i, j])
        spread = (covariances(known, rows) * (noise(known, rows) ** 2)[:, None, None]).sum(axis=0) + _drifted(m, rows)
        if not np.isfinite(spread).all() or not _one(way, spread, density[i]):
            m.apart[ids] = fewer // 5
            continue
        keep, drop = (i, j) if known.seen[i] >= known.seen[j] else (j, i)
        gone.add(drop)
        join(m, keep, drop)
    if gone:
        m.counters.accept("merged objects", len(gone))
        without(m, np.array(sorted(gone)))


def _one(way: Floats, spread: Floats, density: float) -> bool:
    """Whether two landmarks `way` (3,) m apart are one: by the covariance (3, 3) of that, and by how many of their label
    there are per m^2, one of which may stand there as well."""
    squared = float(way @ np.linalg.solve(spread, way))
    area = 2 * np.pi * np.sqrt(np.linalg.det(spread[:2, :2]))
    return squared <= _SAME and -np.log(area * density) - squared / 2 >= _ODDS


def _drifted(m: Mapper, rows: Ints) -> Floats:
    """Covariance (3, 3) of two landmarks' places to each other by how the path drifted between their last sightings.

    Or by how little the newest pose is known, if that is less: both bound what the graph knows, which takes too long to ask.
    """
    k, known = m.keyframes, m.known
    newest = int(np.argmax(k.stamp))
    pose = m.graph.pose(int(k.id[newest]))
    first, second = rows[np.argsort(known.last[rows], kind="stable")]
    to = (known.position[rows].mean(axis=0) - pose[:3, 3])[None]
    camera_from_drift = adjoint(inverse(k.start_T_base[newest] @ k.base_T_camera[newest]))
    gained = camera_from_drift @ gathered(known.drift[second], known.drift[first][None]) @ camera_from_drift.T
    since = carried(to, gained, pose)[0]
    if not np.isfinite(m.doubt).all():
        return since
    placed = carried(to, m.doubt, pose)[0]
    return placed if np.trace(placed) < np.trace(since) else since


def _drop_ghosts(m: Mapper) -> None:
    """Landmarks that are hardly ever seen where they should be."""
    known = m.known
    ghost = np.flatnonzero((known.expected >= _GHOST_FRAMES) & (known.seen < _GHOST * known.expected))
    if len(ghost):
        m.counters.accept("ghosts dropped", len(ghost))
        mine = np.isin(m.rays.owner, known.id[ghost])
        m.graph.drop_rays(m.rays.number[mine])
        m.rays.owner[mine], m.rays.used[mine] = -1, False
        without(m, ghost)
