"""Closes loops. Several landmarks seen now are recognised together as landmarks seen long ago, and are merged with them."""

from contextlib import suppress

import numpy as np

from objslam.association import place_recognition
from objslam.association.refinement import normalised_residuals
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse
from objslam.core.statistics import OUTLIER_RAY
from objslam.errors import SolveError
from objslam.graph.loop_closure import distribute_correction
from objslam.live.mapper.landmark_table import covariances
from objslam.live.mapper.landmark_update import merge_landmarks, remove_landmarks
from objslam.live.mapper.pose_uncertainty import gathered, long_unseen
from objslam.live.mapper.state import MapState

_ANCHORS = 3  # The number of past keyframes that are tried as the start of the loop. More keyframes take longer.
_NEAR = 0.25  # A correction above this (m) bends the path before landmarks merge. A larger value leaves more to iSAM2.
_TURNED = 0.05  # A heading correction above this (rad) bends the path before landmarks merge, as a shift above _NEAR does.
_AROUND = 6.0
"""Other landmarks within this radius (m) of recognised landmarks match rays again. In a hall, cameras see about this far. In
a larger radius, more landmarks match again."""
_ERA = 15.0  # Landmarks _AROUND match if seen within this time (s) of the recognised ones. A longer time matches more.
_ITERATIONS = 5  # The most iterations of the solve after a loop closure. More iterations delay the next frame.
_TOLERANCE = 1e-3  # The relative decrease of the cost below which the solve gives up. A smaller value takes longer.
_HOLDS = 0.7  # The share of a loop's rays that must be inliers. A larger share undoes more loops, right and wrong ones.
_BENT = 0.02  # The assumed error (m) of the corrected path, added to the noise of rays. A larger error accepts more rays.


def close_loop(m: MapState) -> None:
    """Search for a loop and close it. If too many rays then contradict the loop, the map is restored."""
    landmarks = m.landmarks
    newest = int(np.argmax(m.keyframes.stamp))
    there = long_unseen(m.keyframes.drift[newest], landmarks.drift)
    here = ~there
    state = (tuple(landmarks.id[here].tolist()), int(there.sum()))
    if state == m.schedule.compared:
        return
    m.schedule.compared = state
    together = _together(m)
    possible = here[:, None] & there & (landmarks.label[:, None] == landmarks.label) & ~together
    one, two = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    if min(len(one), len(two)) < place_recognition.MIN_LANDMARKS:
        return
    found = _recognise(m, one, two, possible[np.ix_(one, two)], newest, together)
    if found is not None:
        _close(m, one[found.pairs[:, 0]], two[found.pairs[:, 1]], found.correction)


def _recognise(
    m: MapState, one: Ints, two: Ints, possible: Bools, newest: int, together: Bools
) -> place_recognition.Recognition | None:
    """Return how the landmarks in rows `one` surely match the landmarks in rows `two`, or None without a sure match.

    The match must be better than matches between landmarks that some frame shows `together` (N, N). Landmarks that a frame
    shows together are different things, and match only because places look alike. possible: which pairs may be the same.
    newest: the row of the newest keyframe.
    """
    landmarks, k = m.landmarks, m.keyframes
    pivot = m.graph.pose(int(k.id[newest]))[:2, 3]
    density = place_recognition.label_densities(landmarks.position, landmarks.label)
    a, b = (
        place_recognition.neighbourhood(landmarks.position[n], covariances(landmarks, n), landmarks.label[n], pivot)
        for n in (one, two)
    )
    lately = np.unique(landmarks.last[two])[::-1]
    rows = np.arange(len(landmarks))
    best: place_recognition.Recognition | None = None
    for stamp in lately[np.linspace(0, len(lately) - 1, min(_ANCHORS, len(lately))).astype(np.int64)]:
        anchor = int(np.argmin(np.abs(k.stamp - stamp)))
        if k.stamp[anchor] >= k.stamp[newest]:
            continue
        prior = _planar(m, anchor, newest)
        found = place_recognition.recognise_place(a, b, pivot, prior, density[one], possible)
        if (
            found is None
            or not found.is_sure(m.settings.association)
            or (best is not None and found.evidence <= best.evidence)
        ):
            continue
        table, here = (landmarks.position, covariances(landmarks, rows), landmarks.label), np.isin(rows, one)
        repeated = place_recognition.repetition(*table, here, together, pivot, prior, density)
        if found.against(repeated).is_sure(m.settings.association):
            best = found
    return best


def _planar(m: MapState, before: int, now: int) -> Floats:
    """Return a fast upper bound (3, 3) on the covariance of x, y (m) and yaw (rad) between keyframes in two rows.

    It is the smaller of two bounds. One is the drift between the keyframes, the other the uncertainty of the newest pose.
    """
    k = m.keyframes
    turn = np.kron(np.eye(2), m.graph.pose(int(k.id[now]))[:3, :3])
    to_camera = adjoint(k.camera_T_start[now])
    drift = to_camera @ (k.drift[now] - k.drift[before]) @ to_camera.T
    spreads = [turn @ spread @ turn.T for spread in (drift, m.pose_covariance) if np.isfinite(spread).all()]
    least = min(spreads, key=lambda spread: float(np.trace(spread[3:, 3:])))
    return np.asarray(least[np.ix_([3, 4, 2], [3, 4, 2])] + np.diag(place_recognition.POSE_FLOOR) ** 2)


def _together(m: MapState) -> Bools:
    """Return a mask (N, N) of the pairs of landmarks of one label that some frame showed together."""
    result = np.zeros((len(m.landmarks), len(m.landmarks)), dtype=bool)
    if m.pairs.together:
        a, b = m.rows_of(np.array(list(m.pairs.together))).T
        result[a, b] = result[b, a] = True
    return result


def _close(m: MapState, now: Ints, old: Ints, correction: Floats) -> None:
    """Merge the landmarks in rows `now` (P,) into the landmarks in rows `old` (P,). A large correction (4, 4) bends the
    path."""
    turn = abs(np.arctan2(correction[1, 0], correction[0, 0]))
    pivot = m.landmarks.position[now].mean(axis=0)
    shift = np.linalg.norm((correction[:3, :3] @ pivot + correction[:3, 3] - pivot)[:2])
    if not (shift < _NEAR and turn < _TURNED):
        _bend(m, now, old, correction)
        return
    _expect_around(m, now, old)
    _merge(m, now, old)
    m.schedule.relinearise_soon()
    m.counters.accept("merged objects", len(now))


def _merge(m: MapState, now: Ints, old: Ints, rebuild: bool = True) -> None:
    for i, j in zip(old.tolist(), now.tolist(), strict=True):
        merge_landmarks(m, i, j)
    remove_landmarks(m, np.unique(now), rebuild)


def _expect_around(m: MapState, now: Ints, old: Ints) -> None:
    """Let the long unseen landmarks around the landmarks in rows `old` (P,) match rays again.

    Each of them gets the drift of the first seen landmark in rows `now` (P,), as if the two had been last seen together.
    """
    landmarks = m.landmarks
    drift = landmarks.drift[now[np.argmin(landmarks.first[now])]]
    since = gathered(drift, landmarks.drift)
    near = np.linalg.norm(landmarks.position[:, :2] - landmarks.position[old, :2].mean(axis=0), axis=1) < _AROUND
    same_time = np.abs(landmarks.last - np.median(landmarks.last[old])) < _ERA
    expected = near & same_time & (np.trace(since, axis1=1, axis2=2) > 0)
    expected[now] = expected[old] = False
    landmarks.drift[expected] = drift


def _bend(m: MapState, now: Ints, old: Ints, correction: Floats) -> None:
    """Distribute the correction over the path, merge rows `now` (P,) into `old` (P,), and solve the map.

    If too few rays are then inliers, restore the old map.
    """
    landmarks, k, rays = m.landmarks, m.keyframes, m.rays
    m.graph.refresh()
    saved = m.graph.save()
    turned = rays.to_centre.copy(), rays.centre_sigma.copy()
    table = landmarks.copy(), rays.owner.copy(), m.pairs.together.copy(), m.pairs.apart.copy()
    _expect_around(m, now, old)
    order = m.time_order()
    poses, stamps = m.graph.poses(k.id[order]), k.stamp[order]
    left, back = float(landmarks.last[old].max()), float(landmarks.first[now].min())
    begin = int(np.searchsorted(stamps, min(left, back)).clip(0, len(order) - 2))
    end = max(int(np.searchsorted(stamps, max(back, left)).clip(0, len(order) - 1)), begin + 1)
    drift = np.maximum.accumulate(k.drift[order][:, 2, 2])
    bent = distribute_correction(poses, correction, begin, end, drift)
    # Each landmark moves with the last pose from which it was seen.
    last = np.searchsorted(stamps, landmarks.last).clip(0, len(order) - 1)
    carried = bent[last] @ inverse(poses[last])
    points = np.einsum("nij,nj->ni", carried[:, :3, :3], landmarks.position) + carried[:, :3, 3]
    m.graph.set_estimate(k.id[order], bent, landmarks.id, points)
    landmarks.position[:] = points
    landmarks.yaw[:] += np.arctan2(carried[:, 1, 0], carried[:, 0, 0])
    mine = np.flatnonzero(np.isin(rays.owner, landmarks.id[np.concatenate([now, old])]) & rays.used)
    _merge(m, now, old, rebuild=False)
    if _settles(m, mine):
        m.schedule.relinearise_soon()
        m.counters.accept("loops closed")
        m.counters.accept("merged objects", len(old))
        m.move_tracks(correction, back)
        return
    m.counters.accept("loops not closed after all")
    m.landmarks, rays.owner[:], m.pairs.together, m.pairs.apart = table
    rays.to_centre[:], rays.centre_sigma[:] = turned
    m.graph.restore(saved)
    m.read_positions()


def _settles(m: MapState, mine: Ints) -> bool:
    """Solve the corrected graph until the rays in rows `mine` (n,) hold, and return whether they do.

    After one step on the Bayes tree, iterations of Levenberg-Marquardt follow. The next frame waits for all iterations, so
    they end as soon as the rays hold. Later relinearisations complete the solve.
    """
    with suppress(SolveError):
        m.graph.rebuild()
        if _holds(m, mine):
            return True
    with suppress(SolveError):
        for _ in range(_ITERATIONS):
            decrease = m.graph.iterate()
            if _holds(m, mine):
                m.graph.rebuild()
                return True
            if decrease < _TOLERANCE:
                break
    return False


def _holds(m: MapState, mine: Ints) -> bool:
    """Return whether enough of the rays in rows `mine` (n,) are inliers."""
    m.graph.refresh()
    m.read_positions()
    obs = m.sight(mine)
    points = m.landmarks.position[m.rows_of(m.rays.owner[mine])]
    distance = np.linalg.norm(points - obs.origin, axis=1)
    allowed = OUTLIER_RAY * np.hypot(1.0, _BENT / (distance * obs.sigma))
    return bool(np.mean(normalised_residuals(obs, points) < allowed) >= _HOLDS)
