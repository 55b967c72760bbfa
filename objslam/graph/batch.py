"""The whole log in one factor graph: objects with fixed poses, or poses and objects together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.geometry import inverse
from objslam.graph import factors
from objslam.graph.grow import anchor, grow, landmark_priors, range_factors, ray_factors
from objslam.graph.marginals import largest_sigma, marginal_covariances, seen_covariances
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
from objslam.graph.watch import watch_solve
from objslam.ledger import Ledger
from objslam.rays import angles_off
from objslam.trace import Trace
from objslam.triangulation import Triangulation, triangulate
from objslam.types import Association, Bools, Floats, Ints, Keyframes, Rays

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
class Estimate:
    """What a solve found.

    map_T_base: (K, 4, 4). positions: (N, 3) m. covariance: (N, 3, 3) m^2, NaN where not solved. solved: (N,) whether the
    object was part of the graph. seen_sigma: (N,) m, the largest standard deviation of its place as seen from a camera that
    saw it: the map's own drift up to there is not in it. NaN where not solved. weight: (R,) each ray's robust weight in
    [0, 1], 0 without object or when rejected. The costs are the graph's error at the first start and at the last optimum;
    for Eq. 1 its sum of distances, m.
    """

    map_T_base: Floats
    positions: Floats
    covariance: Floats
    seen_sigma: Floats
    solved: Bools
    weight: Floats
    cost_before: float
    cost_after: float
    iterations: int


def triangulate_at(
    map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Triangulation:
    """Every object by Eq. 1 at the camera poses (K, 4, 4); poses that are localised bring their own noise to the rays."""
    origins, directions = rays.in_map(map_T_camera)
    sigma, place = pose_noise(rays, keyframes, settings)
    return triangulate(
        origins,
        directions,
        association.object,
        association.count,
        sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=rays.range if np.isfinite(rays.range).any() else None,
        range_sigma=rays.range_sigma,
        position_sigma=place,
    )


def solve_fixed(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    start: Triangulation,
    settings: Settings,
    trace: Trace | None = None,
) -> Estimate:
    """The objects with the poses as they are, from the triangulation on: one point-to-line factor for each of its inliers.

    With the loss `l1` this is Eq. 1, and the covariance is the triangulation's, which also places the objects that need
    their ranges for it. The other losses weigh each ray by its noise across at the object's distance, and take a measured
    range as a factor along the ray. Objects that the triangulation left unresolved stay out.
    """
    loss = settings.fixed.loss
    member = start.ok & np.isfinite(start.gradient) if loss == "l1" else start.ok
    used = np.flatnonzero((start.weight > 0) & np.isin(association.object, np.flatnonzero(member)))
    landmark = association.object[used]
    origins, n = (a[used] for a in rays.in_map(keyframes.map_T_camera))
    angle, place = pose_noise(rays, keyframes, settings)
    across = np.hypot(angle[used] * np.linalg.norm(start.positions[landmark] - origins, axis=1), place)
    noise = factors.robust(loss, np.ones(len(used)) if loss == "l1" else across, 2)
    groups = [factors.point_to_line_fixed(origins, n, landmark, noise)]
    ranged = np.isfinite(rays.range[used]) & (loss != "l1")
    groups.append(
        factors.along_ray(
            origins[ranged], n[ranged], rays.range[used][ranged], rays.range_sigma[used][ranged], landmark[ranged]
        )
    )
    graph, landmarks = build_graph(*groups), np.unique(landmark)
    values = make_values(np.zeros((0, 4, 4)), start.positions, landmarks)
    watch = watch_solve(trace, start.positions, landmarks, keyframes.map_T_camera)
    optimum = _solve(graph, values, loss, settings, range(len(used), graph.size()), tolerance=1e-12, watch=watch)
    positions = with_points(start.positions, landmarks, optimum.values)
    distance = np.linalg.norm(np.cross(positions[landmark] - origins, n), axis=1)
    weight = start.weight.copy()
    weight[used] = _weights(loss, distance / across, optimum)
    covariance = start.covariance
    if loss != "l1":
        information = _across(n) * (weight[used] / across**2)[:, None, None]
        along = np.where(ranged, 1 / rays.range_sigma[used] ** 2, 0.0)
        information += n[:, :, None] * n[:, None, :] * np.where(ranged, along, 0.0)[:, None, None]
        covariance = _inverse_sums(information, landmark, association.count)
        covariance *= _widening(distance / across, landmark, association.count)[:, None, None]
    return Estimate(
        map_T_base=keyframes.map_T_base,
        positions=positions,
        covariance=covariance,
        seen_sigma=largest_sigma(covariance),
        solved=start.ok,
        weight=weight,
        cost_before=optimum.cost_before,
        cost_after=optimum.cost_after,
        iterations=optimum.iterations,
    )


def solve_joint(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    settings: Settings,
    ledger: Ledger,
    progress: Callable[[int, int], None] = lambda done, total: None,
    start: Floats | None = None,
    trace: Trace | None = None,
) -> Estimate:
    """Poses and objects together, from a start that holds: the localisation's poses, or the graph grown along the odometry.

    start: camera poses (K, 4, 4) to begin from instead.
    After each solve, rays that miss their object by far more than its others do are rejected, or taken back, and objects
    that the poses now carry, or place better, enter or move, until nothing changes.
    """
    rays = _share_bias(rays, association, settings)
    positions = np.full((association.count, 3), np.nan)
    map_T_camera = keyframes.map_T_camera
    if start is not None:
        map_T_camera = start
    elif not keyframes.localized_every:
        map_T_camera, positions = grow(keyframes, rays, association, settings, progress, trace)
    used = np.zeros(len(rays), dtype=bool)
    optimum, cost_before, iterations = None, np.nan, 0
    for _ in range(_ROUNDS):
        positions, supported = _second_opinion(map_T_camera, keyframes, rays, association, positions, used, settings)
        if optimum is not None and (supported == used).all():
            break
        used = supported
        graph, others = _joint_graph(keyframes, rays, association, positions, used, settings.joint.loss, settings)
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        values = make_values(map_T_camera, positions, landmarks)
        optimum = _solve(
            graph, values, settings.joint.loss, settings, others, watch=watch_solve(trace, positions, landmarks)
        )
        cost_before = optimum.cost_before if np.isnan(cost_before) else cost_before
        iterations += optimum.iterations
        map_T_camera = read_poses(optimum.values)
        positions = with_points(positions, landmarks, optimum.values)
    assert optimum is not None

    landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
    origins, directions = (a[used] for a in rays.in_map(map_T_camera))
    residual = angles_off(origins, directions, positions[association.object[used]]) / rays.sigma[used]
    weight = np.zeros(len(rays))
    weight[used] = _weights(settings.joint.loss, residual, optimum)
    covariance = np.full((association.count, 3, 3), np.nan)
    gaussian, _ = _joint_graph(keyframes, rays, association, positions, used & (weight > 0), "gnc", settings)
    covariance[landmarks] = marginal_covariances(gaussian, optimum.values, landmarks, ledger)
    seen_sigma = largest_sigma(covariance)
    witness = _witnesses(rays, association, used & (weight > 0))
    reach = np.linalg.norm(positions - map_T_camera[witness, :3, 3], axis=1)
    far = np.flatnonzero(seen_sigma > settings.triangulation.max_rel_sigma * reach)
    seen_sigma[far] = largest_sigma(seen_covariances(gaussian, optimum.values, far, witness[far], ledger))
    widening = _widening(residual, association.object[used], association.count)
    covariance *= widening[:, None, None]
    seen_sigma *= np.sqrt(widening)
    return Estimate(
        map_T_base=map_T_camera @ inverse(keyframes.base_T_camera),
        positions=positions,
        covariance=covariance,
        seen_sigma=seen_sigma,
        solved=np.isfinite(covariance[:, 0, 0]),
        weight=weight,
        cost_before=cost_before,
        cost_after=optimum.cost_after,
        iterations=iterations,
    )


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
    noise = np.minimum(np.sqrt(_widening(miss[before], landmark[before], association.count)), _WIDEST)
    supported = np.zeros(len(rays), dtype=bool)
    supported[placed] = miss <= _OUTLIER * noise[landmark]
    return supported


def _joint_graph(
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


def _solve(
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


def _share_bias(rays: Rays, association: Association, settings: Settings) -> Rays:
    """The rays with the noise of ranges widened so that all of an object's together say no more than their shared bias lets.

    n ranges of noise s that share a bias b have a mean of variance b^2 + s^2 / n: that of n independent ones of s^2 + n b^2.
    """
    ranged = np.isfinite(rays.range) & (association.object >= 0)
    number = np.bincount(association.object[ranged], minlength=association.count)
    sigma = rays.range_sigma.copy()
    sigma[ranged] = np.sqrt(sigma[ranged] ** 2 + number[association.object[ranged]] * settings.depth.bias**2)
    return replace(rays, range_sigma=sigma)


def pose_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float]:
    """The rays' angle noise (R,), rad, and that of their origins, m, with the localisation's own noise in it.

    Keyframes that share a measured pose share its error: their rays count as the one.
    """
    share = keyframes.localized_every
    of = settings.localization
    return np.sqrt(rays.sigma**2 + of.yaw**2 * share), float(of.xy * np.sqrt(share))


def _weights(loss: Loss, residual: Floats, optimum: Optimum) -> Floats:
    if loss == "gnc" and optimum.weights is not None:
        return optimum.weights[: len(residual)]
    if loss == "huber":
        return np.minimum(1.0, factors.HUBER_K / np.maximum(residual, 1e-12))
    if loss == "cauchy":
        return 1 / (1 + (residual / factors.CAUCHY_K) ** 2)
    return np.ones(len(residual))


def _widening(residual: Floats, landmark: Ints, count: int) -> Floats:
    """Factors (N,) >= 1 on the covariances: what the whitened residuals show beyond the noise that was assumed."""
    order = np.lexsort((residual, landmark))
    number = np.bincount(landmark, minlength=count)
    middle = np.clip(np.cumsum(number) - number + number // 2, 0, max(len(residual) - 1, 0))
    median = np.where(number > 5, residual[order][middle], 0.0) if len(residual) else np.zeros(count)
    return np.maximum(1.0, median / _RAYLEIGH_MEDIAN) ** 2


def _witnesses(rays: Rays, association: Association, used: Bools) -> Ints:
    """For each object (N,) the keyframe of the middle one of its used rays, 0 where it has none."""
    object_, keyframe = association.object[used], rays.keyframe[used]
    order = np.lexsort((keyframe, object_))
    number = np.bincount(object_, minlength=association.count)
    middle = np.cumsum(number) - number + number // 2
    witness = np.zeros(association.count, dtype=np.int64)
    witness[number > 0] = keyframe[order][middle[number > 0]]
    return witness


def _across(directions: Floats) -> Floats:
    return np.eye(3) - directions[:, :, None] * directions[:, None, :]


def _inverse_sums(information: Floats, landmark: Ints, count: int) -> Floats:
    total = np.zeros((count, 3, 3))
    np.add.at(total, landmark, information)
    covariance = np.full((count, 3, 3), np.nan)
    held = np.linalg.eigvalsh(total)[:, 0] > 0
    covariance[held] = np.linalg.inv(total[held])
    return covariance
