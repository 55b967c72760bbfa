"""Initialise poses and landmarks with a known association, by growing the graph along the path.

From dead reckoning alone, a batch solve can diverge by kilometres. So keyframes enter a few at a time, at poses that
continue the solved path by odometry. A landmark enters when its rays so far determine its position.
"""

from collections.abc import Callable

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import angles_off, inverse
from objslam.core.trace import Trace
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.fixed_pose_triangulation import triangulate_landmarks
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.variables import make_values, read_poses, with_points

_ITERATIONS = 4
"""The number of iterations of each solve during growth. A larger number is slower. Few are enough, because each solve starts
close to its optimum, and the next solve continues from its result."""
_HOLDS, _FAILS = np.radians(5.0), np.radians(15.0)
"""The limits (rad) on the median angle between rays and landmarks at the predicted poses. Below the first limit, the step
doubles. Above the second, a shorter step is tried. Larger limits take longer steps. On MRCLAM, all limits from 1 and 3 to 5
and 15 degrees converge to the same map. iSAM2 in place of full solves took half the time, but it lost robot 1 or 5."""
_GATE, _GATE_SHARE = np.radians(5.0), 3.0
"""During growth, a ray is an outlier if its angle to its landmark exceeds both `_GATE` (rad) and `_GATE_SHARE` times the
median angle of the step. Larger values let more false boxes in. Both are well above the odometry's drift in one step."""
_MORE_RAYS = 1
"""The number of agreeing rays beyond association.min_rays that a landmark needs to enter. With more rays, landmarks enter
later. With fewer, false boxes agree by chance too often."""
_SHORTEST = 4
"""The divisor of joint.grow_step that gives the shortest step. A larger divisor allows shorter steps and slower growth."""


def initialize_known(
    measured: Measurements, association: Association, progress: Callable[[int, int], None], trace: Trace | None = None
) -> tuple[Floats, Floats]:
    """Return camera poses (K, 4, 4) and landmark positions (N, 3), in map, near the solution. An unknown position is NaN.

    The map frame is the odometry's frame, in which the first keyframe is fixed. progress(done, total) counts keyframes.
    """
    keyframes, rays, settings = measured.keyframes, measured.rays, measured.settings
    map_T_camera = keyframes.map_T_camera.copy()
    positions = np.full((association.count, 3), np.nan)
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    nothing = np.zeros(0, dtype=np.int64)
    graph = build_graph(measured.factors(association.object, nothing, nothing, positions, end=1))
    begin, step = 1, settings.joint.grow_step
    shortest = max(2, step // _SHORTEST)
    while begin < len(keyframes):
        end = min(begin + step, len(keyframes))
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        known = np.append(np.isfinite(positions[:, 0]), False)  # object -1 is the last
        so_far = association.object[: first_ray[end]]
        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        fresh = new[known[so_far[new]]]
        off = _off(rays, association, map_T_camera, positions, fresh)
        waiting = np.flatnonzero((so_far >= 0) & ~known[so_far])
        born, places, agreeing = _new_landmarks(rays, association, map_T_camera, waiting, settings)
        expected = positions.copy()
        expected[born] = places
        off_all = np.concatenate([off, _off(rays, association, map_T_camera, expected, agreeing)])
        surprise = np.median(off_all) if len(off_all) else _HOLDS
        if surprise > _FAILS and step > shortest:
            step = max(step // 4, shortest)
            continue
        fresh = np.concatenate([fresh[off <= max(_GATE, _GATE_SHARE * np.median(off))], agreeing]) if len(off) else agreeing
        positions = expected
        graph.push_back(build_graph(measured.factors(association.object, fresh, born, positions, begin=begin, end=end)))
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        if len(landmarks):
            values = make_values(map_T_camera[:end], positions, landmarks)
            optimum = levenberg_marquardt(graph, values, _ITERATIONS, 1e-4)
            map_T_camera[:end] = read_poses(optimum.values)
            positions = with_points(positions, landmarks, optimum.values)
            if trace is not None:
                trace.iteration("grow", optimum.cost_after, map_T_camera[:end], positions)
        progress(end, len(keyframes))
        begin = end
        if surprise < _HOLDS:
            step *= 2
    return map_T_camera, positions


def _off(rays: Rays, association: Association, map_T_camera: Floats, positions: Floats, which: Ints) -> Floats:
    origins, directions = rays.take(which).in_map(map_T_camera)
    return angles_off(origins, directions, positions[association.object[which]])


def _new_landmarks(
    rays: Rays, association: Association, map_T_camera: Floats, waiting: Ints, settings: Settings
) -> tuple[Ints, Floats, Ints]:
    """Return the landmarks (n,) that the rays `waiting` determine now, their positions (n, 3), and the rays that agree."""
    if len(waiting) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), waiting
    landmarks, index = np.unique(association.object[waiting], return_inverse=True)
    some = Association(index, association.label[landmarks])
    fewest = settings.association.min_rays + _MORE_RAYS
    found, ready = triangulate_landmarks(map_T_camera, rays.take(waiting), some, fewest, settings)
    return landmarks[ready], found.positions[ready], waiting[ready[index] & (found.weight > 0)]
