"""Outlier rejection: the joint solve and a test of every ray alternate until no ray changes sides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off
from objslam.core.statistics import MOST_NOISE_FACTOR, OUTLIER_RAY, STRAY_RAY, noise_factors
from objslam.core.trace import Trace
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.graph.optimizers import Optimum, build_graph, optimize, trace_solve
from objslam.graph.robust_cost import truncated_cost
from objslam.graph.variables import make_values, read_poses, with_points

_BESIDE, _MOST = 5, 0.6
"""The rays before and after a rejected one, and the share of them that are rejected where it is their poses that are wrong;
a larger share takes fewer rays back. Chosen so that a run of a few false boxes in a row is none."""
_ROUNDS = 4
"""The most rounds of solve and test; more is slower, and the last ones change few rays."""
_SURE = 0.95
"""The share of an object's rays that agree with it, below which it is triangulated again; larger is slower, and finds more
objects that stand elsewhere."""

_FEWEST = 6
"""The rays of an object whose median says how noisy they are; of fewer, the promised noise counts. Larger rejects
more rays of noisy objects with few of them. A session goes by the median of fewer, too."""


@dataclass(frozen=True)
class JointSolution:
    """A joint solve: map_T_camera (K, 4, 4), positions (N, 3), and used, (R,) the rays in it, which are no outliers."""

    map_T_camera: Floats
    positions: Floats
    used: Bools
    optimum: Optimum
    cost_before: float
    iterations: int


def reject_outliers(
    measured: Measurements,
    association: Association,
    map_T_camera: Floats,
    positions: Floats,
    used: Bools,
    back: Bools,
    trace: Trace | None,
) -> JointSolution:
    """Solve, and test which rays agree with their objects, until none changes sides.

    Args:
        map_T_camera, positions: (K, 4, 4), (N, 3) to start from; NaN where an object has no position yet.
        used: (R,) the rays that a solve before had, none where there was none.
        back: (R,) rays that the first solve has whether they agree or not.
    """
    loss = measured.settings.joint.loss
    optimum, cost_before, iterations = None, np.nan, 0
    for _ in range(_ROUNDS):
        positions, supported = second_opinion(measured, map_T_camera, association, positions, used)
        if optimum is None:
            supported = supported | back
        elif (supported == used).all():
            break
        used = supported
        which, landmarks = np.flatnonzero(used), np.flatnonzero(np.isfinite(positions[:, 0]))
        graph = build_graph(measured.factors(association.object, which, landmarks, positions, loss))
        values, others = make_values(map_T_camera, positions, landmarks), range(len(which), graph.size())
        traced = trace_solve(trace, positions, landmarks)
        optimum = optimize(graph, values, loss, measured.settings, others, on_iteration=traced)
        cost_before = optimum.cost_before if np.isnan(cost_before) else cost_before
        iterations += optimum.iterations
        map_T_camera = read_poses(optimum.values)
        positions = with_points(positions, landmarks, optimum.values)
    assert optimum is not None
    return JointSolution(map_T_camera, positions, used, optimum, cost_before, iterations)


def rejected_stretches(rays: Rays, association: Association, found: JointSolution) -> Bools:
    """The rejected rays (R,) among whose neighbours in time most are rejected, too: not they are wrong, but their poses."""
    order = np.flatnonzero(np.isin(association.object, np.flatnonzero(np.isfinite(found.positions[:, 0]))))
    order = order[np.argsort(rays.keyframe[order], kind="stable")]
    rejected, window = ~found.used[order], np.ones(2 * _BESIDE + 1)
    back = np.zeros(len(rays), dtype=bool)
    if len(order) >= len(window):
        near, share = (np.convolve(which, window, mode="same") for which in (np.ones(len(order)), rejected))
        back[order] = rejected & (share >= _MOST * near)
    return back


def misfit(map_T_camera: Floats, positions: Floats, measured: Measurements, association: Association) -> float:
    """What tells the better of two solutions of the same rays: camera poses (K, 4, 4) and places (N, 3), NaN where none is.

    A ray whose object has no place counts as a stray.
    """
    placed = np.isfinite(positions[:, 0])
    owner = np.where((association.object >= 0) & placed[association.object], association.object, -1)
    strays = int(((association.object >= 0) & (owner < 0)).sum())
    return STRAY_RAY * strays + truncated_cost(measured.rays, owner, positions, map_T_camera, *measured.odometry())


def second_opinion(
    measured: Measurements, map_T_camera: Floats, association: Association, positions: Floats, used: Bools
) -> tuple[Floats, Bools]:
    """Positions (N, 3), NaN where there is none, and the rays (R,) that agree with them.

    An object that some of its rays disagree with, or that has no place yet, is asked for by consensus of all its rays at
    these poses, and moved where more of them agree.
    """
    keyframes, rays = measured.keyframes, measured.rays
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)
    supported = _supported(rays, association, map_T_camera, positions, used)
    support = np.bincount(association.object[supported], minlength=association.count)
    doubtful = support < _SURE * number
    which = np.isin(association.object, np.flatnonzero(doubtful))
    if not which.any():
        return positions, supported
    objects, index = np.unique(association.object[which], return_inverse=True)
    some = Association(index, association.label[objects])
    if used.any():  # poses that were solved have left the localisation's noise behind
        keyframes = replace(keyframes, localized_every=0.0)
    placed = triangulate_at(map_T_camera, keyframes, rays.take(which), some, measured.settings)
    other = positions.copy()
    other[objects[placed.ok]] = placed.positions[placed.ok]
    gained = np.bincount(
        association.object[_supported(rays, association, map_T_camera, other, used)], minlength=len(support)
    )
    positions = np.where((gained > support)[:, None], other, positions)
    return positions, _supported(rays, association, map_T_camera, positions, used)


def _supported(rays: Rays, association: Association, map_T_camera: Floats, positions: Floats, used: Bools) -> Bools:
    """Which rays (R,) agree with their object, by how noisy those of its rays are that agreed so far (at first all)."""
    placed = np.isin(association.object, np.flatnonzero(np.isfinite(positions[:, 0])))
    landmark = association.object[placed]
    origins, directions = (a[placed] for a in rays.in_map(map_T_camera))
    miss = angles_off(origins, directions, positions[landmark]) / rays.sigma[placed]
    before = used[placed] if used.any() else np.ones(len(miss), dtype=bool)
    noise = np.minimum(noise_factors(miss[before], landmark[before], association.count, _FEWEST), MOST_NOISE_FACTOR)
    supported = np.zeros(len(rays), dtype=bool)
    supported[placed] = miss <= OUTLIER_RAY * noise[landmark]
    return supported


def widening(residual: Floats, landmark: Ints, count: int) -> Floats:
    """Factors (N,) >= 1 on the covariances: what the whitened residuals show beyond the noise that was assumed."""
    return noise_factors(residual, landmark, count, _FEWEST) ** 2
