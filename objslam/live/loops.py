"""A session comes back to where it has been: landmarks of now that are landmarks of long ago become one, several at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.constellation import FEWEST, LEAST, Recognition, densities, neighbourhood, recognise
from objslam.errors import SolveError
from objslam.geometry import adjoint, inverse
from objslam.graph.closure import bend
from objslam.live.joining import join, without
from objslam.live.known import covariances, gathered, long_unseen
from objslam.live.meeting import misses
from objslam.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_ANCHORS = 3
_NEAR, _TURNED = 0.25, 0.05  # m, rad; by a correction smaller than that no factor is linearised far off
_AROUND, _ERA = 6.0, 15.0  # m, s; landmarks so close to recognised ones, last seen at about the same time
_ITERATIONS, _TOLERANCE = 5, 1e-3  # the graph settles the rest in its updates: no frame may wait for it
_HOLDS, _FITS = 0.7, 4.0  # share of a closed loop's rays that must still fit, to so many standard deviations
_BENT = 0.02  # m


def close_loop(m: Mapper) -> None:
    """Look for a loop that closes, and close it; where too many rays contradict it afterwards, all is as it was."""
    known = m.known
    newest = int(np.argmax(m.keyframes.stamp))
    there = long_unseen(m.keyframes.drift[newest], known.drift)
    here = ~there
    state = (tuple(known.id[here].tolist()), int(there.sum()))
    if state == m.looked_at:
        return
    m.looked_at = state
    possible = here[:, None] & there & (known.label[:, None] == known.label) & ~_together(m)
    one, two = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    if len(one) < FEWEST or len(two) < FEWEST:
        return
    found = _recognise(m, one, two, possible[np.ix_(one, two)], newest)
    if found is not None:
        _close(m, one[found.pairs[:, 0]], two[found.pairs[:, 1]], found.correction)


def _recognise(m: Mapper, one: Ints, two: Ints, possible: Bools, newest: int) -> Recognition | None:
    known, k = m.known, m.keyframes
    pivot = m.graph.pose(int(k.id[newest]))[:2, 3]
    density = densities(known.position, known.label)[one]
    a, b = (
        neighbourhood(known.position[which], covariances(known, which), known.label[which], pivot) for which in (one, two)
    )
    lately = np.unique(known.last[two])[::-1]
    best: Recognition | None = None
    for stamp in lately[np.linspace(0, len(lately) - 1, min(_ANCHORS, len(lately))).astype(np.int64)]:
        anchor = int(np.argmin(np.abs(k.stamp - stamp)))
        if k.stamp[anchor] >= k.stamp[newest]:
            continue
        prior = _planar(m, anchor, newest)
        found = recognise(a, b, pivot, prior, density, possible)
        if found is not None and found.sure and (best is None or found.evidence > best.evidence):
            best = found
    return best


def _planar(m: Mapper, before: int, now: int) -> Floats:
    """Covariance (3, 3) of the camera now as seen from before: x, y, yaw along the map's axes.

    What the odometry gathered in between, or the doubt about the place in the map, whichever is less: both are more than
    the graph's own relative covariance, which would take longer than a frame may.
    """
    k = m.keyframes
    turn = np.kron(np.eye(2), m.graph.pose(int(k.id[now]))[:3, :3])
    to_camera = adjoint(inverse(k.start_T_base[now] @ k.base_T_camera[now]))
    drift = to_camera @ (k.drift[now] - k.drift[before]) @ to_camera.T
    spreads = [turn @ spread @ turn.T for spread in (drift, m.doubt) if np.isfinite(spread).all()]
    least = min(spreads, key=lambda spread: float(np.trace(spread[3:, 3:])))
    return np.asarray(least[np.ix_([3, 4, 2], [3, 4, 2])] + np.diag(LEAST) ** 2)


def _together(m: Mapper) -> Bools:
    """Whether two landmarks (N, N) of one label were ever seen in one frame."""
    known = m.known
    result = np.zeros((len(known), len(known)), dtype=bool)
    row = {int(j): i for i, j in enumerate(known.id.tolist())}
    for a, b in m.together:
        result[row[a], row[b]] = result[row[b], row[a]] = True
    return result


def _close(m: Mapper, now: Ints, old: Ints, correction: Floats) -> None:
    """Make landmarks now (P,) one with the old (P,)."""
    turn = abs(np.arctan2(correction[1, 0], correction[0, 0]))
    pivot = m.known.position[now].mean(axis=0)
    shift = np.linalg.norm((correction[:3, :3] @ pivot + correction[:3, 3] - pivot)[:2])
    if shift < _NEAR and turn < _TURNED:
        _expect_around(m, now, old)
        for i, j in zip(old.tolist(), now.tolist(), strict=True):
            join(m, i, j)
        without(m, np.unique(now))
        m.unsettled = True
        m.counters.accept("merged objects", len(now))
    else:
        _bend(m, now, old, correction)


def _expect_around(m: Mapper, now: Ints, old: Ints) -> None:
    """What stands around the old landmarks (P,) is expected again: it has drifted no more since than the new ones (P,)."""
    known = m.known
    drift = known.drift[now[np.argmin(known.first[now])]]
    since = gathered(drift, known.drift)
    near = np.linalg.norm(known.position[:, :2] - known.position[old, :2].mean(axis=0), axis=1) < _AROUND
    same_time = np.abs(known.last - np.median(known.last[old])) < _ERA
    expected = near & same_time & (np.trace(since, axis1=1, axis2=2) > 0)
    expected[now] = expected[old] = False
    known.drift[expected] = drift


def _bend(m: Mapper, now: Ints, old: Ints, correction: Floats) -> None:
    """Bend the path so that landmarks now (P,) lie on the old (P,), make them one, solve; or leave all as it was."""
    known, k, rays = m.known, m.keyframes, m.rays
    m.graph.refresh()
    saved = m.graph.save()
    table = known.copy(), rays.owner.copy(), dict(m.together), dict(m.apart)
    _expect_around(m, now, old)
    order = np.argsort(k.stamp, kind="stable")
    poses, stamps = m.graph.poses(k.id[order]), k.stamp[order]
    left, back = float(known.last[old].max()), float(known.first[now].min())
    begin = int(np.searchsorted(stamps, min(left, back)).clip(0, len(order) - 2))
    end = max(int(np.searchsorted(stamps, max(back, left)).clip(0, len(order) - 1)), begin + 1)
    drift = np.maximum.accumulate(k.drift[order][:, 2, 2])
    bent = bend(poses, correction, begin, end, drift)
    # landmarks go along with the pose that saw them last
    last = np.searchsorted(stamps, known.last).clip(0, len(order) - 1)
    carried = bent[last] @ inverse(poses[last])
    points = np.einsum("nij,nj->ni", carried[:, :3, :3], known.position) + carried[:, :3, 3]
    m.graph.bend(k.id[order], bent, known.id, points)
    known.position[:] = points
    mine = np.flatnonzero(np.isin(rays.owner, known.id[np.concatenate([now, old])]) & rays.used)
    ids = known.id[old]
    for i, j in zip(old.tolist(), now.tolist(), strict=True):
        join(m, i, j)
    without(m, np.unique(now), rebuild=False)
    held = any(_holds(m, mine) for _ in _settled(m))
    if held:
        m.unsettled = True
        m.counters.accept("loops closed")
        m.counters.accept("merged objects", len(ids))
        m.move_candidates(correction, back)
        return
    m.counters.accept("loops not closed after all")
    m.known, rays.owner[:], m.together, m.apart = table
    m.graph.restore(saved)
    m.known.position[:] = m.graph.points(m.known.id)


def _settled(m: Mapper) -> Iterator[None]:
    """The bent graph solved: by one step, which a good correction leaves little to do; then, if asked, by several."""
    for solve in (m.graph.rebuild, lambda: m.graph.solve(_ITERATIONS, _TOLERANCE)):
        with suppress(SolveError):  # then it does not hold
            solve()
            yield


def _holds(m: Mapper, mine: Ints) -> bool:
    """Whether the rays (n,) of the landmarks that became one still fit them."""
    m.graph.refresh()
    m.known.position[:] = m.graph.points(m.known.id)
    s = m.sight(mine)
    points = m.known.position[m.rows_of(m.rays.owner[mine])]
    distance = np.linalg.norm(points - s.origin, axis=1)
    allowed = _FITS * np.hypot(1.0, _BENT / (distance * s.sigma))
    return bool(np.mean(misses(s, points) < allowed) >= _HOLDS)
