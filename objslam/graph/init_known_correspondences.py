"""Initialisation where it is known which ray is of which object: the graph grows along the path.

From dead reckoning alone a batch solve can diverge by kilometres. Here a few keyframes are added at a time at the poses
that the solved ones predict, and an object enters when the rays seen so far, at the poses of that moment, carry a position.
"""

from __future__ import annotations

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
"""The iterations of the solve after each step. Few are enough: each begins close to its optimum, and the next one goes
on from there. More are slower."""
_HOLDS, _FAILS = np.radians(5.0), np.radians(15.0)
"""The median angles (rad) by which landmarks are missed from the predicted poses: below the first the next step is twice as
long, above the second a step is taken back and tried again shorter; larger takes longer steps. The MRCLAM robots converge
to the same map with anything from 1 and 3 to 5 and 15 degrees, and with iSAM2 in place of full solves they do not (settings
of it that took half the time lost robot 1 or 5)."""
_GATE, _GATE_SHARE = np.radians(5.0), 3.0
"""The angle (rad), and the factor on the median of its step, that a ray must both exceed to be left out while the graph
grows; larger lets more false boxes in. Chosen well above what the odometry's drift explains in one step."""
_MORE_RAYS = 1
"""The rays beyond association.min_rays that must agree on a landmark before it enters. With fewer, false boxes agree by
chance too often; with more, landmarks enter later."""
_SHORTEST = 4
"""What joint.grow_step is divided by for the shortest step; larger lets steps become shorter, and the growth slower."""


def initialize_known(
    measured: Measurements,
    association: Association,
    progress: Callable[[int, int], None],
    trace: Trace | None = None,
) -> tuple[Floats, Floats]:
    """A start near the solution: camera poses (K, 4, 4) in map and landmark positions (N, 3), NaN where the rays gave none.

    The map is the odometry's frame: its first keyframe is held. progress(done, total) is called in keyframes.
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
        # the new keyframes follow the last solved one by odometry
        follow = inverse(keyframes.map_T_camera[begin - 1]) @ keyframes.map_T_camera[begin:end]
        map_T_camera[begin:end] = map_T_camera[begin - 1] @ follow

        known = np.append(np.isfinite(positions[:, 0]), False)  # object -1 is the last
        so_far = association.object[: first_ray[end]]
        new = np.arange(first_ray[begin] if begin > 1 else 0, first_ray[end])
        fresh = new[known[so_far[new]]]
        off = _off(rays, association, map_T_camera, positions, fresh)
        born, places, agreeing = _new_landmarks(
            rays, association, map_T_camera, np.flatnonzero((so_far >= 0) & ~known[so_far]), settings
        )
        expected = positions.copy()
        expected[born] = places
        surprise = (
            np.median(np.concatenate([off, _off(rays, association, map_T_camera, expected, agreeing)]))
            if len(off) + len(agreeing)
            else _HOLDS
        )
        if surprise > _FAILS and step > shortest:
            step = max(step // 4, shortest)
            continue
        fresh = np.concatenate([fresh[off <= max(_GATE, _GATE_SHARE * np.median(off))], agreeing]) if len(off) else agreeing
        positions = expected
        for factor in measured.factors(association.object, fresh, born, positions, begin=begin, end=end):
            graph.push_back(factor)
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
    """Landmarks (n,) that the waiting rays carry now, where (n, 3), and which of the rays agree on them."""
    if len(waiting) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), waiting
    landmarks, index = np.unique(association.object[waiting], return_inverse=True)
    some = Association(index, association.label[landmarks])
    fewest = settings.association.min_rays + _MORE_RAYS
    found, ready = triangulate_landmarks(map_T_camera, rays.take(waiting), some, fewest, settings)
    return landmarks[ready], found.positions[ready], waiting[ready[index] & (found.weight > 0)]
