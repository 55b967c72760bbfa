"""A session comes back to where it has been: landmarks of now that are landmarks of long ago become one, several at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from objslam.association.place_recognition import (
    MIN_LANDMARKS,
    POSE_FLOOR,
    Recognition,
    label_densities,
    neighbourhood,
    recognise_place,
)
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

_ANCHORS = 3
"""Moments of the past that a loop is looked for with, each with the drift since then; more take longer."""
_NEAR = 0.25
"""m; by a smaller correction no factor is linearised far off, and the landmarks are merged without solving. Larger trusts
the next updates with more."""
_TURNED = 0.05
"""rad; the same of a correction's heading."""
_AROUND = 6.0
"""m; how far around recognised landmarks others are expected again, about what a robot sees from one place in a hall."""
_ERA = 15.0
"""s; and how far apart the stamps are at which these were last seen. Larger expects more, which then count as missed."""
_ITERATIONS = 5
"""Iterations of the solve once a loop has closed; the graph settles the rest in its updates, for no frame may wait."""
_TOLERANCE = 1e-3
"""Share of the cost below which an iteration gains no more; smaller takes longer."""
_HOLDS = 0.7
"""Share of a closed loop's rays that must still fit; larger undoes more loops, wrong ones and right ones."""
_BENT = 0.02
"""m; what the bent path may be off by besides the rays' noise. Larger lets more rays fit."""


def close_loop(m: MapState) -> None:
    """Look for a loop that closes, and close it; where too many rays contradict it afterwards, all is as it was."""
    landmarks = m.landmarks
    newest = int(np.argmax(m.keyframes.stamp))
    there = long_unseen(m.keyframes.drift[newest], landmarks.drift)
    here = ~there
    state = (tuple(landmarks.id[here].tolist()), int(there.sum()))
    if state == m.schedule.compared:
        return
    m.schedule.compared = state
    possible = here[:, None] & there & (landmarks.label[:, None] == landmarks.label) & ~_together(m)
    one, two = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    if len(one) < MIN_LANDMARKS or len(two) < MIN_LANDMARKS:
        return
    found = _recognise(m, one, two, possible[np.ix_(one, two)], newest)
    if found is not None:
        _close(m, one[found.pairs[:, 0]], two[found.pairs[:, 1]], found.correction)


def _recognise(m: MapState, one: Ints, two: Ints, possible: Bools, newest: int) -> Recognition | None:
    landmarks, k = m.landmarks, m.keyframes
    pivot = m.graph.pose(int(k.id[newest]))[:2, 3]
    density = label_densities(landmarks.position, landmarks.label)[one]
    a, b = (
        neighbourhood(landmarks.position[which], covariances(landmarks, which), landmarks.label[which], pivot)
        for which in (one, two)
    )
    lately = np.unique(landmarks.last[two])[::-1]
    best: Recognition | None = None
    for stamp in lately[np.linspace(0, len(lately) - 1, min(_ANCHORS, len(lately))).astype(np.int64)]:
        anchor = int(np.argmin(np.abs(k.stamp - stamp)))
        if k.stamp[anchor] >= k.stamp[newest]:
            continue
        prior = _planar(m, anchor, newest)
        found = recognise_place(a, b, pivot, prior, density, possible)
        if found is not None and found.is_sure(m.settings.association) and (best is None or found.evidence > best.evidence):
            best = found
    return best


def _planar(m: MapState, before: int, now: int) -> Floats:
    """Covariance (3, 3) of the camera now as seen from before: x, y, yaw along the map's axes.

    The lesser counts of what the odometry gathered in between, and the covariance of the newest pose in the map. Both are
    more than the graph's own relative covariance, which would take longer than a frame may.
    """
    k = m.keyframes
    turn = np.kron(np.eye(2), m.graph.pose(int(k.id[now]))[:3, :3])
    to_camera = adjoint(k.camera_T_start[now])
    drift = to_camera @ (k.drift[now] - k.drift[before]) @ to_camera.T
    spreads = [turn @ spread @ turn.T for spread in (drift, m.pose_covariance) if np.isfinite(spread).all()]
    least = min(spreads, key=lambda spread: float(np.trace(spread[3:, 3:])))
    return np.asarray(least[np.ix_([3, 4, 2], [3, 4, 2])] + np.diag(POSE_FLOOR) ** 2)


def _together(m: MapState) -> Bools:
    """Whether two landmarks (N, N) of one label were ever seen in one frame."""
    landmarks = m.landmarks
    result = np.zeros((len(landmarks), len(landmarks)), dtype=bool)
    row = {int(j): i for i, j in enumerate(landmarks.id.tolist())}
    for a, b in m.pairs.together:
        result[row[a], row[b]] = result[row[b], row[a]] = True
    return result


def _close(m: MapState, now: Ints, old: Ints, correction: Floats) -> None:
    """Make landmarks now (P,) one with the old (P,)."""
    turn = abs(np.arctan2(correction[1, 0], correction[0, 0]))
    pivot = m.landmarks.position[now].mean(axis=0)
    shift = np.linalg.norm((correction[:3, :3] @ pivot + correction[:3, 3] - pivot)[:2])
    if shift < _NEAR and turn < _TURNED:
        _expect_around(m, now, old)
        for i, j in zip(old.tolist(), now.tolist(), strict=True):
            merge_landmarks(m, i, j)
        remove_landmarks(m, np.unique(now))
        m.schedule.relinearise_soon()
        m.counters.accept("merged objects", len(now))
    else:
        _bend(m, now, old, correction)


def _expect_around(m: MapState, now: Ints, old: Ints) -> None:
    """What stands around the old landmarks (P,) is expected in view again, as if last seen when the new (P,) first were."""
    landmarks = m.landmarks
    drift = landmarks.drift[now[np.argmin(landmarks.first[now])]]
    since = gathered(drift, landmarks.drift)
    near = np.linalg.norm(landmarks.position[:, :2] - landmarks.position[old, :2].mean(axis=0), axis=1) < _AROUND
    same_time = np.abs(landmarks.last - np.median(landmarks.last[old])) < _ERA
    expected = near & same_time & (np.trace(since, axis1=1, axis2=2) > 0)
    expected[now] = expected[old] = False
    landmarks.drift[expected] = drift


def _bend(m: MapState, now: Ints, old: Ints, correction: Floats) -> None:
    """Bend the path so that landmarks now (P,) lie on the old (P,), make them one, solve; or leave all as it was."""
    landmarks, k, rays = m.landmarks, m.keyframes, m.rays
    m.graph.refresh()
    saved = m.graph.save()
    table = landmarks.copy(), rays.owner.copy(), dict(m.pairs.together), dict(m.pairs.apart)
    _expect_around(m, now, old)
    order = np.argsort(k.stamp, kind="stable")
    poses, stamps = m.graph.poses(k.id[order]), k.stamp[order]
    left, back = float(landmarks.last[old].max()), float(landmarks.first[now].min())
    begin = int(np.searchsorted(stamps, min(left, back)).clip(0, len(order) - 2))
    end = max(int(np.searchsorted(stamps, max(back, left)).clip(0, len(order) - 1)), begin + 1)
    drift = np.maximum.accumulate(k.drift[order][:, 2, 2])
    bent = distribute_correction(poses, correction, begin, end, drift)
    # landmarks go along with the pose that saw them last
    last = np.searchsorted(stamps, landmarks.last).clip(0, len(order) - 1)
    carried = bent[last] @ inverse(poses[last])
    points = np.einsum("nij,nj->ni", carried[:, :3, :3], landmarks.position) + carried[:, :3, 3]
    m.graph.set_estimate(k.id[order], bent, landmarks.id, points)
    landmarks.position[:] = points
    mine = np.flatnonzero(np.isin(rays.owner, landmarks.id[np.concatenate([now, old])]) & rays.used)
    ids = landmarks.id[old]
    for i, j in zip(old.tolist(), now.tolist(), strict=True):
        merge_landmarks(m, i, j)
    remove_landmarks(m, np.unique(now), rebuild=False)
    held = any(_holds(m, mine) for _ in _settled(m))
    if held:
        m.schedule.relinearise_soon()
        m.counters.accept("loops closed")
        m.counters.accept("merged objects", len(ids))
        m.move_tracks(correction, back)
        return
    m.counters.accept("loops not closed after all")
    m.landmarks, rays.owner[:], m.pairs.together, m.pairs.apart = table
    m.graph.restore(saved)
    m.read_positions()


def _settled(m: MapState) -> Iterator[None]:
    """The bent graph solved: by one step, which a good correction leaves little to do; then, if asked, by several."""
    for solve in (m.graph.rebuild, lambda: m.graph.solve(_ITERATIONS, _TOLERANCE)):
        with suppress(SolveError):  # then it does not hold
            solve()
            yield


def _holds(m: MapState, mine: Ints) -> bool:
    """Whether the rays (n,) of the landmarks that became one still fit them."""
    m.graph.refresh()
    m.read_positions()
    obs = m.sight(mine)
    points = m.landmarks.position[m.rows_of(m.rays.owner[mine])]
    distance = np.linalg.norm(points - obs.origin, axis=1)
    allowed = OUTLIER_RAY * np.hypot(1.0, _BENT / (distance * obs.sigma))
    return bool(np.mean(normalised_residuals(obs, points) < allowed) >= _HOLDS)
