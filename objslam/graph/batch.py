"""The whole log in one factor graph: objects with fixed poses, or poses and objects together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Loss, Settings
from objslam.geometry import inverse
from objslam.graph import factors
from objslam.graph.grow import grow
from objslam.graph.marginals import largest_sigma, marginal_covariances, seen_covariances
from objslam.graph.optimise import (
    Optimum,
    build_graph,
    make_values,
    with_points,
)
from objslam.graph.placing import pose_noise
from objslam.graph.settle import joint_graph, misfit, rejected_stretches, settle, solve, widening
from objslam.graph.watch import watch_solve
from objslam.ledger import Ledger
from objslam.rays import angles_off
from objslam.trace import Trace
from objslam.triangulation import Triangulation
from objslam.types import Association, Bools, Floats, Ints, Keyframes, Rays


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
    optimum = solve(graph, values, loss, settings, range(len(used), graph.size()), tolerance=1e-12, watch=watch)
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
        covariance *= widening(distance / across, landmark, association.count)[:, None, None]
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
    that the poses now carry, or place better, enter or move, until nothing changes. Where a stretch of the drive was
    rejected as a whole, its poses may be wrong, not its rays: these are taken back once, and the better solution counts.
    """
    rays = _share_bias(rays, association, settings)
    positions = np.full((association.count, 3), np.nan)
    map_T_camera = keyframes.map_T_camera
    if start is not None:
        map_T_camera = start
    elif not keyframes.localized_every:
        map_T_camera, positions = grow(keyframes, rays, association, settings, progress, trace)
    nothing = np.zeros(len(rays), dtype=bool)
    found = settle(keyframes, rays, association, settings, map_T_camera, positions, nothing, nothing, trace)
    loose = keyframes.odom_T_base is not None and not keyframes.localized_every
    back = rejected_stretches(rays, association, found) if loose else nothing
    if back.any():
        attempt = trace.aside() if trace is not None else None
        at = found.map_T_camera, found.positions, found.used
        other = settle(keyframes, rays, association, settings, *at, back, attempt)
        before, after = (
            misfit(one.map_T_camera, one.positions, keyframes, rays, association, settings) for one in (found, other)
        )
        if after < before:
            iterations = found.iterations + other.iterations
            found = replace(other, cost_before=found.cost_before, iterations=iterations)
            if trace is not None and attempt is not None:
                trace.take(attempt)
    map_T_camera, positions, used, optimum = found.map_T_camera, found.positions, found.used, found.optimum

    landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
    origins, directions = (a[used] for a in rays.in_map(map_T_camera))
    residual = angles_off(origins, directions, positions[association.object[used]]) / rays.sigma[used]
    weight = np.zeros(len(rays))
    weight[used] = _weights(settings.joint.loss, residual, optimum)
    covariance = np.full((association.count, 3, 3), np.nan)
    gaussian, _ = joint_graph(keyframes, rays, association, positions, used & (weight > 0), "gnc", settings)
    covariance[landmarks] = marginal_covariances(gaussian, optimum.values, landmarks, ledger)
    seen_sigma = largest_sigma(covariance)
    witness = _witnesses(rays, association, used & (weight > 0))
    reach = np.linalg.norm(positions - map_T_camera[witness, :3, 3], axis=1)
    far = np.flatnonzero(seen_sigma > settings.triangulation.max_rel_sigma * reach)
    seen_sigma[far] = largest_sigma(seen_covariances(gaussian, optimum.values, far, witness[far], ledger))
    wider = widening(residual, association.object[used], association.count)
    covariance *= wider[:, None, None]
    seen_sigma *= np.sqrt(wider)
    return Estimate(
        map_T_base=map_T_camera @ inverse(keyframes.base_T_camera),
        positions=positions,
        covariance=covariance,
        seen_sigma=seen_sigma,
        solved=np.isfinite(covariance[:, 0, 0]),
        weight=weight,
        cost_before=found.cost_before,
        cost_after=optimum.cost_after,
        iterations=found.iterations,
    )


def _share_bias(rays: Rays, association: Association, settings: Settings) -> Rays:
    """The rays with the noise of ranges widened so that all of an object's together say no more than their shared bias lets.

    n ranges of noise s that share a bias b have a mean of variance b^2 + s^2 / n: that of n independent ones of s^2 + n b^2.
    """
    ranged = np.isfinite(rays.range) & (association.object >= 0)
    number = np.bincount(association.object[ranged], minlength=association.count)
    sigma = rays.range_sigma.copy()
    sigma[ranged] = np.sqrt(sigma[ranged] ** 2 + number[association.object[ranged]] * settings.depth.bias**2)
    return replace(rays, range_sigma=sigma)


def _weights(loss: Loss, residual: Floats, optimum: Optimum) -> Floats:
    if loss == "gnc" and optimum.weights is not None:
        return optimum.weights[: len(residual)]
    if loss == "huber":
        return np.minimum(1.0, factors.HUBER_K / np.maximum(residual, 1e-12))
    if loss == "cauchy":
        return 1 / (1 + (residual / factors.CAUCHY_K) ** 2)
    return np.ones(len(residual))


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
