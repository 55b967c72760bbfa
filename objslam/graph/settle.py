"""The joint solve, and a second opinion about every ray, in turns until nothing changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.graph import factors
from objslam.graph.cost import STRAY, truncated_cost
from objslam.graph.grow import anchor, landmark_priors, range_factors, ray_factors
from objslam.graph.optimise import (
    Optimum,
    Watch,
    build_graph,
    graduated,
    levenberg_marquardt,
    make_values,
    read_poses,
    with_points,
)
from objslam.graph.placing import triangulate_at
from objslam.graph.watch import watch_solve
from objslam.rays import angles_off
from objslam.trace import Trace
from objslam.types import Association, Bools, Floats, Ints, Keyframes, Rays

_BESIDE, _MOST = 5, 0.6
"""Rays before and after a rejected one, and the share of them that are rejected where it is their poses that are wrong."""
_ROUNDS = 4
"""Outliers are looked for again at the solved poses until nothing changes, this often at the most."""
_OUTLIER = 4.0
"""A ray that misses its object by so many standard deviations is an outlier: 3e-4 of the good ones are."""
_SURE = 0.95
"""An object that fewer than this share of its rays agree with is asked for a second time."""
_WIDEST = 5.0
"""An object's rays may be so many times as noisy as assumed (a large object's box centres are)."""
_RAYLEIGH_MEDIAN = 1.1774
"""The median norm of a standard Gaussian in the plane."""


@dataclass(frozen=True)
class Settled:
    """A joint solve as it has settled: map_T_camera (K, 4, 4), positions (N, 3), and used, (R,) the rays in it."""

    map_T_camera: Floats
    positions: Floats
    used: Bools
    optimum: Optimum
    cost_before: float
    iterations: int


def settle(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    settings: Settings,
    map_T_camera: Floats,
    positions: Floats,
    used: Bools,
    back: Bools,
    trace: Trace | None,
) -> Settled:
    """Solve, and ask which rays agree, in turns until nothing changes; back: (R,) rays that the first solve has anyhow."""
    optimum, cost_before, iterations = None, np.nan, 0
    for _ in range(_ROUNDS):
        positions, supported = _second_opinion(map_T_camera, keyframes, rays, association, positions, used, settings)
        if optimum is None:
            supported = supported | back
        elif (supported == used).all():
            break
        used = supported
        graph, others = joint_graph(keyframes, rays, association, positions, used, settings.joint.loss, settings)
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        values = make_values(map_T_camera, positions, landmarks)
        optimum = solve(graph, values, settings.joint.loss, settings, others, watch=watch_solve(trace, positions, landmarks))
        cost_before = optimum.cost_before if np.isnan(cost_before) else cost_before
        iterations += optimum.iterations
        map_T_camera = read_poses(optimum.values)
        positions = with_points(positions, landmarks, optimum.values)
    assert optimum is not None
    return Settled(map_T_camera, positions, used, optimum, cost_before, iterations)


def rejected_stretches(rays: Rays, association: Association, found: Settled) -> Bools:
    """The rejected rays (R,) among whose neighbours in time most are rejected, too: not they are wrong, but their poses."""
    order = np.flatnonzero(np.isin(association.object, np.flatnonzero(np.isfinite(found.positions[:, 0]))))
    order = order[np.argsort(rays.keyframe[order], kind="stable")]
    rejected, window = ~found.used[order], np.ones(2 * _BESIDE + 1)
    back = np.zeros(len(rays), dtype=bool)
    if len(order) >= len(window):
        near, share = (np.convolve(which, window, mode="same") for which in (np.ones(len(order)), rejected))
        back[order] = rejected & (share >= _MOST * near)
    return back


def misfit(
    map_T_camera: Floats, positions: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> float:
    """What tells the better of two solutions of the same rays: camera poses (K, 4, 4) and places (N, 3), NaN where none is.

    A ray whose object has no place counts as a stray.
    """
    placed = np.isfinite(positions[:, 0])
    owner = np.where((association.object >= 0) & placed[association.object], association.object, -1)
    motion, covariance = factors.motions(keyframes, settings)
    strays = int(((association.object >= 0) & (owner < 0)).sum())
    return STRAY * strays + truncated_cost(rays, owner, positions, map_T_camera, motion, covariance)


def _second_opinion(
    map_T_camera: Floats,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    positions: Floats,
    used: Bools,
    settings: Settings,
) -> tuple[Floats, Bools]:
    """Positions (N, 3), NaN where there is none, and the rays (R,) that agree with them.

    An object that some of its rays disagree with, or that has no place yet, is asked for by consensus of all its rays at
    these poses, and moved where more of them agree.
    """
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
    placed = triangulate_at(map_T_camera, keyframes, rays.take(which), some, settings)
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
    noise = np.minimum(np.sqrt(widening(miss[before], landmark[before], association.count)), _WIDEST)
    supported = np.zeros(len(rays), dtype=bool)
    supported[placed] = miss <= _OUTLIER * noise[landmark]
    return supported


def joint_graph(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    positions: Floats,
    used: Bools,
    loss: Loss,
    settings: Settings,
) -> tuple[gtsam.NonlinearFactorGraph, range]:
    """The graph, its first factors those of the used rays in their order, and the indices of all others."""
    which = np.flatnonzero(used)
    groups = [
        ray_factors(rays, association.object, which, loss, settings),
        range_factors(rays, association.object, which),
        landmark_priors(np.flatnonzero(np.isfinite(positions[:, 0])), positions, settings),
    ]
    if keyframes.odom_T_base is not None:
        groups.append(factors.betweens(*factors.motions(keyframes, settings), 0))
    if keyframes.localized_every:
        groups.append(factors.localizations(keyframes, settings))
    else:
        groups.append([anchor(keyframes.map_T_camera[0])])
    graph = build_graph(*groups)
    return graph, range(len(which), graph.size())


def solve(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    loss: Loss,
    settings: Settings,
    known_inliers: Sequence[int],
    tolerance: float = 1e-6,
    watch: Watch | None = None,
) -> Optimum:
    if loss == "gnc":
        return graduated(graph, values, settings.joint.max_iterations, known_inliers)
    return levenberg_marquardt(graph, values, settings.joint.max_iterations, tolerance, watch)


def widening(residual: Floats, landmark: Ints, count: int) -> Floats:
    """Factors (N,) >= 1 on the covariances: what the whitened residuals show beyond the noise that was assumed."""
    order = np.lexsort((residual, landmark))
    number = np.bincount(landmark, minlength=count)
    middle = np.clip(np.cumsum(number) - number + number // 2, 0, max(len(residual) - 1, 0))
    median = np.where(number > 5, residual[order][middle], 0.0) if len(residual) else np.zeros(count)
    return np.maximum(1.0, median / _RAYLEIGH_MEDIAN) ** 2
