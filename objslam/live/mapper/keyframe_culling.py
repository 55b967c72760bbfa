"""The culling of old keyframes, which bounds the size of the map."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.live.mapper.localization import chain_keyframes
from objslam.live.mapper.state import MapState

_NEWEST = 1 / 3  # The newest keyframes that stay, as a share of live.max_keyframes. With a larger share, more old ones go.
_OLDEST = 1 / 30  # The oldest keyframes that stay, as a share of live.max_keyframes. They tie the map to its start.
_SHARE = 0.25  # The share of live.max_keyframes that one culling removes. A larger share makes culling rarer and longer.
_AGAIN = 0.1  # New keyframes before the next culling, as a share of live.max_keyframes. A larger share culls less often.
_ENOUGH = 10  # The rays that every landmark keeps. A larger number keeps more keyframes and more certain landmarks.
_LEAST = 3  # The rays that every landmark keeps if too many keyframes stay (_CROWDED). Three rays still fix a position.
_CROWDED = 1.2  # _LEAST applies if _ENOUGH keeps over this multiple of live.max_keyframes. A larger value costs memory.


def cull_keyframes(m: MapState) -> None:
    """Remove old keyframes if the map has more than live.max_keyframes. Begin where keyframes are closest together.

    One call never removes two consecutive keyframes. The motions before and after a removed keyframe become one motion. The
    next culling waits for some new keyframes (_AGAIN).
    """
    k, most = m.keyframes, m.settings.live.max_keyframes
    if len(k) <= most or m.next_id.keyframe < m.schedule.culled + _AGAIN * most:
        return
    m.schedule.culled = m.next_id.keyframe
    order, wanted = m.time_order(), len(k) - int((1 - _SHARE) * most)
    out = _dispensable(m, order, wanted, _ENOUGH)
    if len(k) - out.sum() > _CROWDED * most:
        out = _dispensable(m, order, wanted, _LEAST)
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
    m.rebuild_in_slices()


def _dispensable(m: MapState, order: Ints, wanted: int, fewest: int) -> Bools:
    """Return a mask (K,), in time order, of the keyframes to remove. It selects at most `wanted` keyframes.

    Every landmark keeps at least `fewest` rays, unless it has fewer already. order: (K,) rows in time order.
    """
    k, rays, most = m.keyframes, m.rays, m.settings.live.max_keyframes
    step = np.linalg.norm(np.diff(k.start_T_base[order][:, :3, 3], axis=0), axis=1)
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
