"""Bounded growth: of many keyframes, the older ones are left out where they are densest, and the odometry is summed up."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.live.mapper.localization import chain_keyframes
from objslam.live.mapper.state import MapState

_NEWEST = 1 / 3
"""Share of live.max_keyframes, the newest, that stay in any case; larger leaves more of the older ones out."""
_OLDEST = 1 / 30
"""The same of the oldest, whose rays alone tell how the map lies to where the robot began."""
_SHARE = 0.25
"""Share of live.max_keyframes that is left out at a time; larger is done less often, and takes longer."""
_AGAIN = 0.1
"""Share of live.max_keyframes that must come until the next time, however many there are; smaller delays other duties."""
_ENOUGH = 10
"""Rays that a landmark keeps; larger keeps more keyframes, and landmarks more certain."""
_LEAST = 3
"""Rays that a landmark keeps where too many keyframes would stay with more; three are what a place takes."""
_CROWDED = 1.2
"""Times live.max_keyframes that may stay until landmarks keep the least; larger uses more memory."""


def cull_keyframes(m: MapState) -> None:
    """Remove older keyframes, where they are densest, when there are more than live.max_keyframes.

    One call never removes two neighbours. After a removal, some new keyframes must come before the next one. The odometry
    between the keyframes that stay is summed up.
    """
    k, most = m.keyframes, m.settings.live.max_keyframes
    if len(k) <= most or m.next_id.keyframe < m.schedule.culled + _AGAIN * most:
        return
    m.schedule.culled = m.next_id.keyframe
    order = np.argsort(k.stamp, kind="stable")
    out = _dispensable(m, order, len(k) - int((1 - _SHARE) * most), _ENOUGH)
    if len(k) - out.sum() > _CROWDED * most:  # very many landmarks of few rays each
        out = _dispensable(m, order, len(k) - int((1 - _SHARE) * most), _LEAST)
    leaving = k.id[order[out]]
    lost: Bools = np.isin(m.rays.keyframe, leaving)
    m.graph.drop_rays(m.rays.number[lost])
    m.graph.drop_keyframes(leaving)
    m.rays.keep(~lost)
    k.keep(~np.isin(k.id, leaving))
    gone = set(leaving.tolist())
    m.localization.pending = [number for number in m.localization.pending if number not in gone][-most:]
    for track in m.tracks:
        track.rays = [ray for ray in track.rays if ray[1] not in gone]
    m.tracks = [track for track in m.tracks if track.rays]
    chain_keyframes(m)
    m.counters.accept("keyframes left out", len(leaving))
    m.graph.rebuild_in_slices(m.in_order())
    m.read_positions()


def _dispensable(m: MapState, order: Ints, wanted: int, fewest: int) -> Bools:
    """Which keyframes, in order (K,), can go: at most `wanted`, and no landmark is left with fewer rays than `fewest`."""
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
