"""Bounded growth: of many keyframes, the older ones are left out where they are densest, and the odometry is summed up."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.graph import factors
from objslam.types import Bools, Ints

if TYPE_CHECKING:
    from objslam.live.mapper import Mapper

_NEWEST, _OLDEST = 1 / 3, 1 / 30
"""Of live.max_keyframes that are never left out: the newest, and the oldest, whose rays alone tell how the map lies to where
the robot began."""
_SHARE = 0.25  # of them that are left out at a time,
_AGAIN = 0.1  # of them that must come until then, however many there are: other things are due, too
_FEWEST = 10  # rays that a landmark keeps,
_CROWDED, _LEAST = 1.2, 3  # or so few, where more than so many times live.max_keyframes would stay


def thin_if_many(m: Mapper) -> None:
    """Thin where there are more than live.max_keyframes, but not over and over again."""
    most = m.settings.live.max_keyframes
    if len(m.keyframes) > most and m.keyframes_so_far >= m.thinned + _AGAIN * most:
        m.thinned = m.keyframes_so_far
        _thin(m)


def _thin(m: Mapper) -> None:
    """Leave out the older keyframes where they are densest, never two in a row, and sum up the odometry."""
    k, most = m.keyframes, m.settings.live.max_keyframes
    order = np.argsort(k.stamp, kind="stable")
    out = _dispensable(m, order, len(k) - int((1 - _SHARE) * most), _FEWEST)
    if len(k) - out.sum() > _CROWDED * most:  # very many landmarks of few rays each
        out = _dispensable(m, order, len(k) - int((1 - _SHARE) * most), _LEAST)
    leaving = k.id[order[out]]
    lost: Bools = np.isin(m.rays.keyframe, leaving)
    m.graph.drop_rays(m.rays.number[lost])
    m.graph.drop_keyframes(leaving)
    m.rays.keep(~lost)
    k.keep(~np.isin(k.id, leaving))
    gone = set(leaving.tolist())
    m.unlocalized = [number for number in m.unlocalized if number not in gone][-m.settings.live.max_keyframes :]
    for candidate in m.candidates:
        candidate.rays = [ray for ray in candidate.rays if ray[1] not in gone]
    m.candidates = [candidate for candidate in m.candidates if candidate.rays]
    _chain(m)
    m.counters.accept("keyframes left out", len(leaving))
    m.graph.rebuild_in_turns(m.in_order())
    m.known.position[:] = m.graph.points(m.known.id)


def _dispensable(m: Mapper, order: Ints, wanted: int, fewest: int) -> Bools:
    """Which keyframes, in their order (K,), can go, so many at the most, so that no landmark is left with fewer rays."""
    k, rays, most = m.keyframes, m.rays, m.settings.live.max_keyframes
    place = k.start_T_base[order][:, :3, 3]
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    span = np.full(len(order), np.inf)
    span[1:-1] = step[:-1] + step[1:]
    span[: int(_OLDEST * most)] = span[len(span) - int(_NEWEST * most) :] = np.inf
    used = np.flatnonzero(rays.used)
    used = used[np.argsort(rays.keyframe[used], kind="stable")]
    owner = rays.owner[used].tolist()
    begin, end = (np.searchsorted(rays.keyframe[used], k.id[order], side).tolist() for side in ("left", "right"))
    left = np.bincount(owner, minlength=1).tolist()
    out = [False] * len(order)
    for i in np.argsort(span, kind="stable")[: int(np.isfinite(span).sum())].tolist():
        if not wanted:
            break
        mine = owner[begin[i] : end[i]]
        if out[i - 1] or out[i + 1] or any(left[j] <= fewest for j in mine):
            continue
        for j in mine:
            left[j] -= 1
        out[i] = True
        wanted -= 1
    return np.array(out)


def _chain(m: Mapper) -> None:
    """The odometry between the keyframes that are left, in the order of time."""
    if m.localized_only:
        return
    k = m.keyframes
    order = np.argsort(k.stamp, kind="stable")
    ids = k.id[order].tolist()
    anew = [i for i in range(1, len(ids)) if m.graph.before(ids[i]) != ids[i - 1]]
    pairs = np.array([[i - 1, i] for i in anew], dtype=np.int64).ravel()
    motion, covariance = factors.motions(m.keyframe_arrays(order[pairs]), m.settings, m.odometry.planar)
    for i, step, spread in zip(anew, motion[::2], covariance[::2], strict=True):
        m.graph.add_motion(ids[i - 1], ids[i], step, spread)
