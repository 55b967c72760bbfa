"""A start that holds: the graph grown along the path, so that no solve ever begins far from its answer.

From dead reckoning alone a batch solve can diverge by kilometres. Here a few keyframes are added at a time at the poses
that the solved ones predict, and an object enters when the rays seen so far, at the poses of that moment, carry a position.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.geometry import inverse
from objslam.graph import factors
from objslam.graph.optimise import build_graph, levenberg_marquardt, make_values, read_points, read_poses
from objslam.rays import angles_off
from objslam.trace import Trace
from objslam.triangulation import triangulate
from objslam.types import Association, Floats, Ints, Keyframes, Rays

_ITERATIONS = 4  # a step: each begins close to its optimum, and the next one goes on from there
_HOLDS, _FAILS = np.radians(5.0), np.radians(15.0)
"""How far off, in the median, landmarks are seen from the predicted poses: below, the odometry is good enough for a next
step twice as long; above, a step is taken back and tried again shorter. The MRCLAM robots converge to the same map with
anything from 1 and 3 to 5 and 15 degrees, and with iSAM2 in place of full solves they do not (settings of it that took half
the time lost robot 1 or 5)."""
_GATE, _GATE_SHARE = np.radians(5.0), 3.0
"""A ray off by more than this, and than so many times what is usual in its step, is left out while the graph grows."""
_FEWEST = 4  # rays that must agree on a landmark before it enters: with fewer, false boxes agree by chance too often
_SHORTEST = 4  # of joint.grow_step, the part that a step is never shorter than
_L1_RADIANS = 1e-4
_EQ1_SIGMA = 0.05  # m; Eq. 1 knows no noise of its own: this weighs its metres against the odometry


def grow(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    settings: Settings,
    progress: Callable[[int, int], None],
    trace: Trace | None = None,
) -> tuple[Floats, Floats]:
    """Camera poses (K, 4, 4) in map and landmark positions (N, 3), NaN where the rays never carried one.

    The map is the odometry's frame: its first keyframe is held. progress(done, total) is called in keyframes.
    """
    motion, covariance = factors.motions(keyframes, settings)
    map_T_camera = keyframes.map_T_camera.copy()
    positions = np.full((association.count, 3), np.nan)
    first_ray = np.searchsorted(rays.keyframe, np.arange(len(keyframes) + 1))
    graph = build_graph([anchor(map_T_camera[0])])
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
        born, places, agreeing = _births(
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
        for group in (
            factors.betweens(motion[begin - 1 : end - 1], covariance[begin - 1 : end - 1], begin - 1),
            ray_factors(rays, association.object, fresh, "huber", settings),
            range_factors(rays, association.object, fresh),
            landmark_priors(born, positions, settings),
        ):
            for factor in group:
                graph.push_back(factor)
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        if len(landmarks):
            values = make_values(map_T_camera[:end], positions, landmarks)
            optimum = levenberg_marquardt(graph, values, _ITERATIONS, 1e-4)
            map_T_camera[:end] = read_poses(optimum.values)
            positions[landmarks] = read_points(optimum.values)
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


def ray_factors(rays: Rays, landmark: Ints, which: Ints, loss: Loss, settings: Settings) -> list[gtsam.NonlinearFactor]:
    """The factors of the rays `which` (n,) in their order: bearing, or point-to-line as set; landmark: (R,)."""
    keyframe, directions, landmark = rays.keyframe[which], rays.direction[which], landmark[which]
    if settings.joint.factor == "bearing":
        return factors.bearing(keyframe, directions, landmark, factors.robust(loss, rays.sigma[which], 2, _L1_RADIANS))
    metres = factors.robust(loss, np.full(len(which), _EQ1_SIGMA), 2)
    return factors.point_to_line(keyframe, directions, landmark, metres)


def range_factors(rays: Rays, landmark: Ints, which: Ints) -> list[gtsam.NonlinearFactor]:
    """The factors of the ranges that came with the rays `which` (n,), under Cauchy's loss; landmark: (R,)."""
    which = which[np.isfinite(rays.range[which])]
    noise = factors.robust("cauchy", rays.range_sigma[which], 1)
    return factors.ranges(rays.keyframe[which], rays.range[which], landmark[which], noise)


def landmark_priors(landmarks: Ints, positions: Floats, settings: Settings) -> list[gtsam.NonlinearFactor]:
    """A weak prior on each of the landmarks at its place in positions (N, 3): it keeps the graph determined."""
    weak = gtsam.noiseModel.Isotropic.Sigma(3, settings.joint.prior_sigma)
    return [gtsam.PriorFactorPoint3(factors.l_key(j), positions[j], weak) for j in landmarks.tolist()]


def anchor(map_T_camera: Floats) -> gtsam.NonlinearFactor:
    """Hold X(0) where the odometry starts: bearings and odometry alone do not say where the map lies."""
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    return gtsam.PriorFactorPose3(factors.x_key(0), gtsam.Pose3(map_T_camera), tight)


def _births(
    rays: Rays, association: Association, map_T_camera: Floats, waiting: Ints, settings: Settings
) -> tuple[Ints, Floats, Ints]:
    """Landmarks (n,) that the waiting rays carry now, where (n, 3), and which of the rays agree on them."""
    if len(waiting) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), waiting
    landmarks, index = np.unique(association.object[waiting], return_inverse=True)
    some = rays.take(waiting)
    origins, directions = some.in_map(map_T_camera)
    found = triangulate(
        origins,
        directions,
        index,
        len(landmarks),
        some.sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=some.range if np.isfinite(some.range).any() else None,
        range_sigma=some.range_sigma,
    )
    ranged = np.bincount(index, np.isfinite(some.range), len(landmarks)) > 0
    ready = found.ok & (found.counts >= _FEWEST)
    ready &= ranged | (found.parallax >= np.radians(settings.joint.min_parallax_deg))
    return landmarks[ready], found.positions[ready], waiting[ready[index] & (found.weight > 0)]
