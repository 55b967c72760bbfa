"""The periodic maintenance of a map: solves, outlier rejection, merging of duplicates, loop closure, and bounded growth."""

from dataclasses import dataclass

import numpy as np

from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.association.observations import Observations
from objslam.association.place_recognition import label_densities
from objslam.association.refinement import normalised_residuals
from objslam.association.single_object_fit import PointFit, fit_point
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint
from objslam.core.statistics import MOST_NOISE_FACTOR, OUTLIER_RAY, SAME_POINT, noise_factors, quantile
from objslam.errors import SolveError
from objslam.live.mapper.keyframe_culling import cull_keyframes
from objslam.live.mapper.landmark_table import covariances, in_view, noise
from objslam.live.mapper.landmark_update import drop_landmarks, merge_landmarks, remove_landmarks
from objslam.live.mapper.loop_closure import close_loop
from objslam.live.mapper.pose_uncertainty import PoseUncertainty
from objslam.live.mapper.state import MapState
from objslam.live.mapper.track_promotion import AGREE, SLACK, add_landmark, fit_if_observable
from objslam.mapping.joint.labels import MANY, SECOND

_EVERY = 10  # The period of every task in keyframes. A larger period keeps duplicates and false landmarks for longer.
_GROWING = 3  # The keyframe of each period after which tracks and keyframes are dropped and all rays are tested.
_CLOSING = 6  # The keyframe of each period for merging and removing landmarks. It differs from _GROWING to spread delay.
_QUIET = 9  # The keyframe of each period without a task. It is odd: relinearisations (`_BREATH`) are at even keyframes.
_BREATH = 2  # The period of relinearisations after a large change, in keyframes. A larger period settles the map later.
_FIRST = 20  # The number of keyframes at the first full solve. Fewer keyframes have too few rays of any landmark.
_GROWTH = 1.5  # The growth factor of keyframes between full solves. A larger factor keeps early errors longer.
_ITERATIONS = 8  # The most iterations of a full solve. More iterations delay the next frame.
_LARGE = 200  # With more keyframes, a rebuild in slices replaces the full solve. A larger number delays the next frame more.
_ODDS = 2.5  # The least log odds that two landmarks are one object, not two neighbours. Larger odds leave more duplicates.
_HALF = 0.5  # The share of inliers below which a landmark is triangulated again. A larger share redoes more landmarks.
_VISITS = 6
"""At least this number of changes between inliers and outliers, in time order, shows two objects of one label. Drift makes
only one run of outliers, with two changes. With a larger number, both objects need more visits."""
_DRIFT = 5.0
"""The largest assumed drift of a path, as a multiple of the drift in the settings. Real robots drift by up to 3.3 times.
With a larger value, two objects of a label are recognised as two only if they are farther apart, or visited more often."""
_DISTANT = 60.0  # The time (s) after which an unseen track with enough rays is dropped. A larger time keeps more tracks.
_AROUND = 0.15  # The border outside the image, as a share of the image, that is soon seen. A larger share prepares more.
_USUAL = 0.75  # Up to this quantile of all `far`, any landmark is soon seen. A larger value prepares more landmarks.


@dataclass(frozen=True)
class _SecondObject:
    """Another object of the label of a landmark.

    row: the row of the landmark. rays: (n,) the rows of the rays that show the other object. fit: the position of the other
    object. obs: these rays in the frame map. far: whether no drift of the path explains its distance from the landmark.
    """

    row: int
    rays: Ints
    fit: PointFit
    obs: Observations
    far: bool


def is_quiet(number: int) -> bool:
    """Return whether no task is due at a keyframe. At such a keyframe, work that may be done at any time delays the next
    frame less."""
    return number % _EVERY == _QUIET


def maintain(m: MapState) -> None:
    """Run the tasks that are due after a keyframe."""
    rebuilding = m.graph.is_rebuilding
    m.graph.continue_rebuild()
    number, schedule = m.next_id.keyframe, m.schedule
    due = number % _EVERY == 0 or (schedule.relinearisations > 0 and number % _BREATH == 0)
    relinearise = due and not rebuilding  # A rebuild relinearises anyway.
    if relinearise:
        schedule.relinearisations = max(0, schedule.relinearisations - 1)
    m.graph.prepare(_coming(m), relinearise)
    if number % _EVERY == _GROWING:
        tasks = _forget_tracks, cull_keyframes, _polish_if_grown
    elif number % _EVERY == _CLOSING and not m.by_label:
        tasks = close_loop, _merge_duplicates, _drop_ghosts
    else:
        return
    m.read_positions()
    for task in tasks:
        if not m.graph.is_rebuilding:
            task(m)


def _coming(m: MapState) -> Ints:
    """Return the ids (n,) of the landmarks that the camera of the newest keyframe should see, or may see soon."""
    landmarks, keyframes = m.landmarks, m.keyframes
    if not len(landmarks.id):
        return landmarks.id
    pose, camera = m.graph.pose(int(keyframes.id[-1])), m.cameras[keyframes.camera[-1]]
    reach = quantile(landmarks.far, _USUAL)
    return np.asarray(landmarks.id[in_view(landmarks, camera, pose, -_AROUND, reach)])


def _polish_if_grown(m: MapState) -> None:
    """If the graph has grown by `_GROWTH`, solve it, and test which rays are outliers.

    A large graph is not solved here, but rebuilt in slices. A graph is also rebuilt if the test changes which rays are
    outliers.
    """
    if m.next_id.keyframe < max(_FIRST, _GROWTH * m.schedule.solved) or not len(m.landmarks):
        return
    m.schedule.solved = m.next_id.keyframe
    large = len(m.keyframes) > _LARGE
    try:
        if not large:
            m.graph.solve(_ITERATIONS)
    except SolveError:
        m.counters.accept("solves given up")
    changed, second = _reconsider(m)
    if changed or large:
        m.rebuild_in_slices()
    else:
        m.read_positions()
    apart = [one for one in second if one.far]
    for one in apart:
        _separate(m, one)
    if apart:
        m.graph.update()


def _reconsider(m: MapState) -> tuple[bool, list[_SecondObject]]:
    """Reject rays that are outliers now, and restore rejected rays that are inliers now.

    The landmark of a name is triangulated again if few of its rays are inliers. If the rays of a name show two objects, it
    becomes a class. Return whether any ray changed, and the second objects.
    """
    second: list[_SecondObject] = []
    rays, landmarks = m.rays, m.landmarks
    m.graph.refresh()
    m.read_positions()
    held = np.flatnonzero(rays.owner >= 0)
    if not len(held):
        return False, second
    row = m.rows_of(rays.owner[held])
    obs = m.sight(held)
    off = normalised_residuals(obs, landmarks.position[row])
    before = rays.used[held] & np.isfinite(off)
    noise_factor = np.minimum(noise_factors(off[before], row[before], len(landmarks)), MOST_NOISE_FACTOR)
    support: Bools = off <= OUTLIER_RAY * noise_factor[row]
    named = m.kinds.name(landmarks.label)
    if named.any():
        number, fits = np.bincount(row, minlength=len(landmarks)), np.bincount(row[support], minlength=len(landmarks))
        if m.settings.association.method == "auto":
            # The path of a session bends more than that of the whole drive. A solve of the drive can judge the label again.
            judged = m.kinds.is_confirmed(landmarks.label) & (len(rays.owner) <= m.settings.live.reassociate)
            second = _second_objects(m, obs, held, row, support, named & ~judged)
        for one in second:
            m.note_class(int(landmarks.label[one.row]))
        single = named & np.isin(np.arange(len(landmarks)), [one.row for one in second], invert=True)
        for j in np.flatnonzero(single & (fits < _HALF * number) & (number >= MANY)).tolist():
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
    return bool(len(out) or len(back)), second


def _second_objects(
    m: MapState, obs: Observations, held: Ints, row: Ints, support: Bools, named: Bools
) -> list[_SecondObject]:
    """Return the second object of each landmark whose rays show two objects. Its rays are the outliers of the landmark.

    The outliers of such a landmark fit one point. In addition, inliers and outliers alternate (_VISITS), or the point is
    farther away than the path drifts. obs: the rays, in time order. held: (R,) their rows in `m.rays`. row: (R,) the row of
    each ray's landmark. support: (R,) which rays are inliers. named: (N,) which landmarks have a name.
    """
    found: list[_SecondObject] = []
    against = np.bincount(row[~support], minlength=len(m.landmarks))
    number = np.bincount(row, minlength=len(m.landmarks))
    for j in np.flatnonzero(named & (against >= MANY) & (against > SECOND * number)).tolist():
        mine = np.flatnonzero(row == j)
        outliers = mine[~support[mine]]
        fit = fit_if_observable(obs.take(outliers), MANY, AGREE, m.settings, m.rng)
        if fit is None:
            continue
        visits = (np.diff(support[mine].astype(np.int64)) != 0).sum()
        far = _farther_than_drift(m, j, fit, held[mine[support[mine]]], held[outliers])
        if far or visits >= _VISITS:
            found.append(_SecondObject(j, held[outliers], fit, obs.take(outliers), far))
    return found


def _farther_than_drift(m: MapState, j: int, fit: PointFit, inliers: Ints, outliers: Ints) -> bool:
    """Return whether a point is too far from landmark j (row) to be a duplicate, and too far for any drift of the path.

    inliers, outliers: rows of `m.rays`. The drift is counted between the inlier and the outlier that are closest in time.
    """
    k = m.keyframes
    way = fit.position - m.landmarks.position[j]
    if not len(inliers) or np.linalg.norm(way) <= m.settings.association.duplicate_distance:
        return False
    one, other = (np.searchsorted(k.id, m.rays.keyframe[at]) for at in (inliers, outliers))
    apart = np.abs(k.stamp[one][:, None] - k.stamp[other])
    first, last = np.unravel_index(apart.argmin(), apart.shape)
    earlier, later = sorted((int(one[first]), int(other[last])), key=lambda number: float(k.stamp[number]))
    pose = m.graph.pose(int(k.id[later]))
    unknown = np.full((6, 6), np.nan)
    uncertainty = PoseUncertainty(k.drift[later], adjoint(k.camera_T_start[later]), unknown)
    drifted = uncertainty.of_landmarks((fit.position - pose[:3, 3])[None], k.drift[earlier][None], pose)[0]
    spread = fit.covariance + covariances(m.landmarks, np.array([j]))[0] + _DRIFT**2 * drifted
    return bool(way @ np.linalg.solve(spread, way) > SAME_POINT)


def _separate(m: MapState, second: _SecondObject) -> None:
    """Make a new landmark from those outliers of a landmark that show another object."""
    k = m.keyframes
    rows = np.searchsorted(k.id, m.rays.keyframe[second.rays])
    last = rows[k.stamp[rows].argmax()]
    seen = float(k.stamp[rows].min()), float(k.stamp[last])
    add_landmark(m, second.rays, second.fit, second.obs, seen, k.drift[last])
    m.landmarks.rejected[second.row] = 0


def _forget_tracks(m: MapState) -> None:
    now, live = float(m.keyframes.stamp.max()), m.settings.live
    waits = (live.forget, _DISTANT)
    m.tracks = [t for t in m.tracks if t.by_label or now - t.last < waits[len(t.rays) >= live.min_rays]]


def _merge_duplicates(m: MapState) -> None:
    """Merge near landmarks of one label that no or few frames show together, if they are probably one object (`_one`)."""
    landmarks = m.landmarks
    if len(landmarks) < 2:
        return
    a, b, apart = near_pairs(landmarks.position, landmarks.label, m.settings.association.duplicate_distance)
    density = label_densities(landmarks.position, landmarks.label)
    gone: set[int] = set()
    for i, j, way in zip(a.tolist(), b.tolist(), apart, strict=True):
        ids = int(landmarks.id[i]), int(landmarks.id[j])
        fewer = min(int(landmarks.seen[i]), int(landmarks.seen[j]))
        tested = m.pairs.apart.get(ids) == fewer // 5
        if tested or gone & {i, j} or seen_as_two(m.pairs.together.get(ids, 0), fewer):
            continue
        rows = np.array([i, j])
        spread = (covariances(landmarks, rows) * (noise(landmarks, rows) ** 2)[:, None, None]).sum(axis=0)
        spread = spread + _drifted(m, rows)
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
    """Return whether two landmarks are one object, and not two neighbours.

    way: (3,) m, from one landmark to the other. spread: (3, 3) m^2, the covariance of `way`. density: landmarks of the label
    per m^2.
    """
    squared = float(way @ np.linalg.solve(spread, way))
    area = 2 * np.pi * np.sqrt(np.linalg.det(spread[:2, :2]))
    return squared <= SAME_POINT and -np.log(area * density) - squared / 2 >= _ODDS


def _drifted(m: MapState, rows: Ints) -> Floats:
    """Return an upper bound (3, 3), m^2, on the covariance that drift adds to the way between two landmarks."""
    k, landmarks = m.keyframes, m.landmarks
    newest = int(np.argmax(k.stamp))
    pose = m.graph.pose(int(k.id[newest]))
    first, second = rows[np.argsort(landmarks.last[rows], kind="stable")]
    to = (landmarks.position[rows].mean(axis=0) - pose[:3, 3])[None]
    uncertainty = PoseUncertainty(landmarks.drift[second], adjoint(k.camera_T_start[newest]), m.pose_covariance)
    return uncertainty.of_landmarks(to, landmarks.drift[first][None], pose)[0]


def _drop_ghosts(m: MapState) -> None:
    """Remove the landmarks that were seen in too small a share of the frames that should show them (live.ghost_share)."""
    landmarks, live = m.landmarks, m.settings.live
    rarely_seen = landmarks.seen < live.ghost_share * landmarks.expected
    named = m.kinds.name(landmarks.label)
    ghost = np.flatnonzero(~named & (landmarks.expected >= live.ghost_frames) & rarely_seen)
    if len(ghost):
        m.counters.accept("ghosts dropped", len(ghost))
        drop_landmarks(m, ghost)
