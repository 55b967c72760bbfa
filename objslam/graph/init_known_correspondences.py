"""Initialise poses and landmarks with a known association, by growing the graph along the path.

From dead reckoning alone, a batch solve can diverge by kilometres. So keyframes are added a few at a time, at the last
solved pose plus odometry. Each time, a sliding window is solved. A landmark is added when its rays determine it.
"""

from collections.abc import Callable

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off, inverse
from objslam.core.trace import Trace
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.fixed_pose_triangulation import triangulate_landmarks
from objslam.graph.sliding_window import SlidingWindow

_ITERATIONS = 4
"""The largest number of iterations of each solve during growth. A few are enough, because each solve starts near its
optimum, and the next solve starts at its result. A larger number is slower."""
_HOLDS, _FAILS = np.radians(5.0), np.radians(15.0)
"""The limits (rad) on the median angle between rays and landmarks at the predicted poses of a step. Below `_HOLDS`, the next
step is twice as long. Above `_FAILS`, a shorter step is tried. Larger limits take longer steps. On the MRCLAM logs, all
pairs of limits from (1, 3) to (5, 15) degrees lead to the same map."""
_GATE, _GATE_SHARE = np.radians(5.0), 3.0
"""Two limits on the angle between a ray and its landmark during growth. They are `_GATE` (rad), and `_GATE_SHARE` times the
median angle of the step. A ray above both limits is an outlier. Larger values accept more false boxes. The odometry's drift
in one step is well below both limits."""
_MORE_RAYS = 1
"""The number of agreeing rays beyond association.min_rays that a new landmark needs. With a larger number, landmarks are
added later. With a smaller number, false boxes agree by chance more often."""
_SHORTEST = 4
"""The number by which joint.grow_step is divided to get the shortest step, which has at least 2 keyframes. A larger number
allows shorter steps."""
_AGAIN = 1.05
"""The factor by which the number of rays of a landmark grows before the landmark is triangulated again. Only landmarks that
are not in the graph yet are triangulated again. A larger factor is faster, but landmarks are added later. With a factor of
1, the time grows with the square of the number of rays."""
_RECORDED = 1.02
"""The factor by which the graph grows before the trace records the next step. A larger factor records fewer steps. Each step
records the whole path, so with a factor of 1 the trace of a long drive would take gigabytes."""


def initialize_known(
    measured: Measurements, association: Association, progress: Callable[[int, int], None], trace: Trace | None = None
) -> tuple[Floats, Floats]:
    """Return camera poses (K, 4, 4) and landmark positions (N, 3), in map, near the solution. An unknown position is NaN.

    The map frame is the odometry's frame, in which the first keyframe is fixed. progress(done, total) counts keyframes.
    """
    keyframes, rays, settings, owner = measured.keyframes, measured.rays, measured.settings, association.object
    window = SlidingWindow(measured, owner, association.count)
    map_T_camera = window.map_T_camera
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    # The rays whose object is not in the graph yet, and their number at the last triangulation of each object.
    waiting, tried = np.zeros(0, dtype=np.int64), np.zeros(association.count)
    begin, step, recorded = 1, settings.joint.grow_step, 0
    shortest = max(2, step // _SHORTEST)
    while begin < len(keyframes):
        end = min(begin + step, len(keyframes))
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        known = np.append(np.isfinite(window.positions[:, 0]), False)  # The last entry is for rays without an object (-1).
        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        fresh, unknown = new[known[owner[new]]], new[(owner[new] >= 0) & ~known[owner[new]]]
        off = _off(rays, association, map_T_camera, window.positions, fresh)
        before = np.concatenate([waiting[~known[owner[waiting]]], unknown])
        number = np.bincount(owner[before], minlength=association.count)
        again = np.maximum(_AGAIN * tried, settings.association.min_rays + _MORE_RAYS)
        due = (number >= again) | (end == len(keyframes))
        born, places, covariance, agreeing = _new_landmarks(
            rays, association, map_T_camera, before[due[owner[before]]], settings
        )
        expected = window.positions.copy()
        expected[born] = places
        off_all = np.concatenate([off, _off(rays, association, map_T_camera, expected, agreeing)])
        surprise = np.median(off_all) if len(off_all) else _HOLDS
        if surprise > _FAILS and step > shortest:
            step = max(step // 4, shortest)
            continue
        fresh = np.concatenate([fresh[off <= max(_GATE, _GATE_SHARE * np.median(off))], agreeing]) if len(off) else agreeing
        waiting, tried = before, np.where(due, number, tried)
        window.positions = expected
        window.extend(end, fresh, born, covariance)
        if np.isfinite(window.positions[:, 0]).any():
            optimum = window.solve(_ITERATIONS)
            if trace is not None and (end >= _RECORDED * recorded or end == len(keyframes)):
                recorded = end
                trace.iteration("grow", optimum.cost_after, map_T_camera[:end], window.positions)
        progress(end, len(keyframes))
        begin = end
        if surprise < _HOLDS:
            step *= 2
    return map_T_camera, window.positions


def _off(rays: Rays, association: Association, map_T_camera: Floats, positions: Floats, which: Ints) -> Floats:
    origins, directions = rays.take(which).in_map(map_T_camera)
    return angles_off(origins, directions, positions[association.object[which]])


def _new_landmarks(
    rays: Rays, association: Association, map_T_camera: Floats, waiting: Ints, settings: Settings
) -> tuple[Ints, Floats, Floats, Ints]:
    """Triangulate landmarks from the rays `waiting` (w,) at the camera poses (K, 4, 4).

    Return the determined landmarks (n,), their positions (n, 3) and covariances (n, 3, 3), and their inlier rays (m,).
    """
    waiting = waiting[_may_have_parallax(rays.take(waiting), association.object[waiting], map_T_camera, settings)]
    if len(waiting) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), waiting
    landmarks, index = np.unique(association.object[waiting], return_inverse=True)
    some = Association(index, association.label[landmarks])
    fewest = settings.association.min_rays + _MORE_RAYS
    found, ready = triangulate_landmarks(map_T_camera, rays.take(waiting), some, fewest, settings)
    agreeing = waiting[ready[index] & (found.weight > 0)]
    return landmarks[ready], found.positions[ready], found.covariance[ready], agreeing


def _may_have_parallax(rays: Rays, owner: Ints, map_T_camera: Floats, settings: Settings) -> Bools:
    """Return a mask (R,) of the rays whose landmark may have enough parallax, or has a ray with a range.

    This quick test avoids triangulations that must fail. The angle between two rays of a landmark is at most twice the
    largest angle between one of its rays and their mean direction.
    """
    _, directions = rays.in_map(map_T_camera)
    mean = np.zeros((owner.max(initial=-1) + 1, 3))
    np.add.at(mean, owner, directions)
    widest, ranged = np.zeros(len(mean)), np.zeros(len(mean), dtype=bool)
    np.maximum.at(widest, owner, 2 * angles_off(np.zeros(3), directions, mean[owner]))
    ranged[owner[np.isfinite(rays.range)]] = True
    return ((widest >= np.radians(settings.joint.min_parallax_deg)) | ranged)[owner]
