"""Solve a whole log in one factor graph: objects at fixed poses, or poses and objects together."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Loss, Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import angles_off
from objslam.core.ground.flattening import flattened_lines, flattened_points, raised_covariances, raised_points
from objslam.core.statistics import CAUCHY_K, HUBER_K, widening
from objslam.core.trace import Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements, fixed_pose_factors
from objslam.graph.factors.odometry_motions import find_ties
from objslam.graph.factors.range import share_bias
from objslam.graph.fixed_pose_triangulation import flat_noise
from objslam.graph.init_known_correspondences import initialize_known
from objslam.graph.multi_start import MultiStart
from objslam.graph.multiframes import Multiframes
from objslam.graph.optimizers import Optimum, build_graph, optimize, trace_solve
from objslam.graph.outlier_rejection import ROUNDS, JointSolution, misfit, reject_outliers, rejected_stretches
from objslam.graph.posterior.evidence import log_evidence
from objslam.graph.posterior.marginals import (
    Solved,
    SolvedGraph,
    SolvedMeasurements,
    correlated_factor,
    joint_covariances,
    largest_sigma,
    marginal_covariances,
    seen_covariances,
)
from objslam.graph.robust_cost import ray_information
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.estimate import with_objects
from objslam.graph.tags.fixed import tags_at_poses
from objslam.graph.variables import make_values, with_points
from objslam.triangulation.triangulate import Triangulation

_TOLERANCE, _TOLERANCE_BEFORE = 1e-6, 1e-3
"""A joint solve ends if an iteration decreases the cost by less than this share. The first value is for a solve without
shared errors. The second is for a solve with shared errors, because their estimation moves everything again. Larger values
end it sooner."""
_ROUNDS_BEFORE = 2
"""The most rounds of solve and test before the shared errors are estimated. The estimation tests the inliers after each of
its steps. A larger number is slower, and leads to the same inliers."""


def solve_fixed(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    start: Triangulation,
    settings: Settings,
    trace: Trace | None = None,
) -> Estimate:
    """Solve the objects at fixed poses, starting from the triangulation, with one factor for each inlier.

    The loss `l1` is Eq. 1. For this loss, the triangulation gives the covariances. It also gives the positions that Eq. 1
    cannot give without ranges. The other losses weigh the angle of each ray by its noise, and add a factor along the ray for
    a measured range. Objects that the triangulation did not resolve are left out.
    """
    loss = settings.fixed.loss
    member = start.ok & np.isfinite(start.gradient) if loss == "l1" else start.ok
    used = np.flatnonzero((start.weight > 0) & np.isin(association.object, np.flatnonzero(member)))
    landmark = association.object[used]
    some = share_bias(rays, association).take(used)
    angle, place, scale = flat_noise(rays, keyframes, settings)
    angle = angle[used]
    # The solve is in the flattened world, where a ray has one noise in all directions.
    origins, n, longer = flattened_lines(*some.in_map(keyframes.map_T_camera), scale)
    some = replace(some, range=some.range * longer, range_sigma=some.range_sigma * longer)
    flat = flattened_points(start.positions, scale)
    distance = _distances(origins, flat[landmark])
    factors = fixed_pose_factors(some, origins, n, landmark, distance, (angle, place), loss)
    graph, landmarks = build_graph(factors), np.unique(landmark)
    values = make_values(np.zeros((0, 4, 4)), flat, landmarks)
    traced = trace_solve(trace, flat, landmarks, keyframes.map_T_camera, scale)
    others = range(len(used), graph.size())
    optimum = optimize(graph, values, loss, settings, others, tolerance=1e-12, on_iteration=traced)
    flat = with_points(flat, landmarks, optimum.values)
    distance = _distances(origins, flat[landmark])
    across = np.hypot(angle * distance, place)
    residual = angles_off(origins, n, flat[landmark]) * distance / across
    weight = start.weight.copy()
    weight[used] = _weights(loss, residual, optimum)
    covariance = start.covariance
    if loss != "l1":
        along = np.where(np.isfinite(some.range), some.range_sigma**-2, 0.0)
        information = ray_information(n, weight[used] / across**2, along, landmark, association.count)
        held = np.linalg.eigvalsh(information)[:, 0] > 0
        covariance = np.full((association.count, 3, 3), np.nan)
        covariance[held] = np.linalg.inv(information[held])
        covariance = raised_covariances(covariance, scale)
        covariance *= widening(residual, landmark, association.count)[:, None, None]
    return Estimate(
        map_T_base=keyframes.map_T_base,
        positions=raised_points(flat, scale),
        covariance=covariance,
        seen_sigma=largest_sigma(covariance),
        solved=start.ok,
        weight=weight,
        cost_before=optimum.cost_before,
        cost_after=optimum.cost_after,
        iterations=optimum.iterations,
        tags=tags_at_poses(keyframes, rays, association, settings),
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
    errors: CalibratedMeasurements | None = None,
    theta: Floats | None = None,
    hold: bool = False,
    places: Floats | None = None,
) -> Estimate:
    """Solve poses and objects together, from the poses of the localisation, or from a graph that grew along the odometry.

    Each solve is followed by a test of all rays. Rays far outside the noise of their object are rejected, and other rays
    return. An object is added or moved if the poses now determine it better. Solve and test repeat until nothing changes. If
    most rays of a stretch of the drive were rejected, and there is only odometry, the poses of the stretch may be wrong. In
    this case, its rays return once, and the solution with the lower cost is taken. Images of one stamp share one pose. The
    corners of fiducials are landmarks of their own inside the solve, tied to squares (`graph.tags`).

    Args:
        progress: called as progress(done, total) with numbers of keyframes in the growing graph.
        start: (K, 4, 4) camera poses to start from instead.
        places: (N, 3) m, positions to start from, NaN where unknown. They are given if `start` and `places` are the solution
            of nearly the same measurements. Then the stretches that this solution rejects are not tried again.
        errors: the same keyframes and rays as a function of shared errors. The shared errors are estimated, starting from
            theta (P,) or from their mean. Their covariance is added to the covariance of objects.
        hold: whether the shared errors stay at theta. Then the noise stays too, and no covariance is added.

    Raises:
        SolveError: the linear system is indeterminate, or the cost is not finite.
    """
    tags = TagCorners.of(rays, association, settings)
    if trace is not None:
        trace.count = association.count
    if tags is not None:
        errors = None if errors is None else errors.take(errors.keyframes, tags.rays(errors.rays))
        rays, association = tags.rays(rays), tags.association

    multiframes = Multiframes.of(keyframes if errors is None else errors.keyframes)
    theta = errors.mean if theta is None and errors is not None else theta
    given = (keyframes, rays, settings) if errors is None or theta is None else errors.at(theta)
    ties = find_ties(multiframes.keyframes(given[0]), given[2])

    def measure(keyframes: Keyframes, rays: Rays, settings: Settings) -> Measurements:
        return Measurements.of(keyframes, share_bias(rays, association), settings, multiframes, tags, ties)

    measured = measure(*given)
    keyframes, rays = measured.keyframes, measured.rays
    positions = np.full((association.count, 3), np.nan)
    map_T_camera = keyframes.map_T_camera
    if trace is not None:
        trace.base_T_camera = keyframes.base_T_camera
    grown = start is None and not keyframes.localized_every
    if start is not None:
        map_T_camera = start[multiframes.first]
        if places is not None and tags is None:  # The corners of fiducials have no known positions.
            positions = places
    elif grown:
        map_T_camera, positions = initialize_known(measured, association, progress, trace)
    nothing = np.zeros(len(rays), dtype=bool)
    tolerance = _TOLERANCE if errors is None else _TOLERANCE_BEFORE
    rounds = ROUNDS if errors is None else _ROUNDS_BEFORE

    def from_start(map_T_camera: Floats, positions: Floats, trace: Trace | None) -> JointSolution:
        begin = measured, association, map_T_camera, positions, nothing, nothing
        return reject_outliers(*begin, trace, tolerance, rounds, close=grown or places is not None)

    def misfit_of(solution: JointSolution) -> float:
        if errors is None or theta is None or hold:
            return misfit(solution.map_T_camera, solution.positions, measured, association)
        from objslam.graph.calibration.self_calibration import misfit_at_shared_errors

        return misfit_at_shared_errors(errors, measure, association, solution, theta)

    found = from_start(map_T_camera, positions, trace)
    if grown:
        found = MultiStart(measured, association, from_start, misfit_of).best(found, trace)
    loose = keyframes.odom_T_base is not None and not keyframes.localized_every and places is None
    back = rejected_stretches(rays, association, found) if loose else nothing
    if back.any():
        attempt = trace.aside() if trace is not None else None
        before, other, again = misfit(found.map_T_camera, found.positions, measured, association), found, back
        for limit in (1, rounds - 1):  # Returned rays that belong to their objects lower the misfit after the first round.
            begin = measured, association, other.map_T_camera, other.positions, other.used, again
            tried = reject_outliers(*begin, attempt, tolerance, limit, other.near, close=True)
            other, again = replace(tried, iterations=other.iterations + tried.iterations), nothing
            if misfit(other.map_T_camera, other.positions, measured, association) >= before:
                break
        else:
            found = replace(other, cost_before=found.cost_before)
            if trace is not None and attempt is not None:
                trace.take(attempt)
    calibrated, calibration, failed = None, None, False
    if errors is not None and theta is not None and hold:
        calibration = Calibration(errors.names, theta, errors.prior, np.sqrt(np.diagonal(errors.prior)))
    elif errors is not None and theta is not None:
        from objslam.graph.calibration.self_calibration import calibrate  # It imports scipy.sparse. No other solve needs it.

        try:
            calibrated = calibrate(errors, measure, association, found, theta, trace)
        except (SolveError, np.linalg.LinAlgError) as error:
            ledger.warn(f"the shared errors could not be estimated, and stay as they were: {error}")
            calibration = Calibration(errors.names, theta, errors.prior, np.sqrt(np.diagonal(errors.prior)))
            failed = True
        else:
            errors, calibration = calibrated.errors, calibrated.calibration
            measured, found = calibrated.measured, calibrated.found
            keyframes, rays = measured.keyframes, measured.rays
    map_T_camera, positions, used, optimum = found.map_T_camera, found.positions, found.used, found.optimum

    landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
    origins, directions = (a[used] for a in rays.in_map(map_T_camera))
    seen = positions[association.object[used]]
    residual = angles_off(origins, directions, seen) / rays.sigma[used]
    weight = np.zeros(len(rays))
    weight[used] = _weights(settings.joint.loss, residual, optimum)
    covariance = np.full((association.count, 3, 3), np.nan)
    inliers = used & (weight > 0)
    at = association.object, inliers, map_T_camera, positions
    solved: Solved = SolvedMeasurements(measured, association, *at[1:], found.near)
    if tags is not None:
        solved = SolvedGraph(measured.whole(*at, "gnc")[0], optimum.values)
    covariance[landmarks] = marginal_covariances(solved, landmarks, ledger)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    drift = correlated_factor(solved, known, covariance[known])
    correlated = np.zeros((association.count, 3, drift.shape[2]))
    correlated[known] = drift
    seen_sigma = largest_sigma(covariance)
    witness = _witnesses(rays, association, used & (weight > 0))
    reach = np.linalg.norm(positions - map_T_camera[witness, :3, 3], axis=1)
    far = np.flatnonzero(seen_sigma > settings.triangulation.max_rel_sigma * reach)
    seen_sigma[far] = largest_sigma(seen_covariances(solved, far, witness[far], ledger))
    body = np.arange(association.count) if tags is None else tags.object_of_landmark()
    wider = widening(residual, body[association.object[used]], association.count)[body]
    covariance *= wider[:, None, None]
    seen_sigma *= np.sqrt(wider)
    if calibrated is not None:
        by_error = calibrated.sensitivity
        covariance += by_error @ calibrated.calibration.covariance @ np.swapaxes(by_error, 1, 2)
        covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
        correlated = np.concatenate([correlated, np.nan_to_num(by_error) @ calibrated.calibration.root], axis=2)
    estimate = Estimate(
        map_T_base=measured.map_T_base(map_T_camera),
        positions=positions,
        covariance=covariance,
        seen_sigma=seen_sigma,
        solved=np.isfinite(covariance[:, 0, 0]),
        weight=weight,
        cost_before=found.cost_before,
        cost_after=optimum.cost_after,
        iterations=found.iterations,
        calibration=calibration if calibration is not None and calibration.names else None,
        noise=None if errors is None else errors.noise,
        correlated=correlated if tags is None else tags.of_objects(correlated),
        log_evidence=log_evidence(
            measured,
            association,
            used,
            np.linalg.norm(seen - origins, axis=1),
            solved,
            optimum.cost_after,
            errors is not None and "ranges" in errors.unknown_noise,
        ),
        uncalibrated=failed,
    )
    if tags is None:
        return estimate
    told = None if calibrated is None else calibrated.sensitivity
    covariances = partial(joint_covariances, solved)
    assert measured.tags is not None
    return with_objects(estimate, measured.tags, rays, map_T_camera, optimum.values, covariances, wider, told, ledger)


def _distances(origins: Floats, points: Floats) -> Floats:
    """Return the distances (R,) m of points (R, 3) from origins (R, 3), at least `MIN_DEPTH`."""
    return np.maximum(np.linalg.norm(points - origins, axis=1), MIN_DEPTH)


def _weights(loss: Loss, residual: Floats, optimum: Optimum) -> Floats:
    if loss == "gnc" and optimum.weights is not None:
        return optimum.weights[: len(residual)]
    if loss == "huber":
        return np.minimum(1.0, HUBER_K / np.maximum(residual, 1e-12))
    if loss == "cauchy":
        return 1 / (1 + (residual / CAUCHY_K) ** 2)
    return np.ones(len(residual))


def _witnesses(rays: Rays, association: Association, used: Bools) -> Ints:
    """Return for each object (N,) the keyframe of its middle used ray, or 0 without one."""
    object_, keyframe = association.object[used], rays.keyframe[used]
    order = np.lexsort((keyframe, object_))
    number = np.bincount(object_, minlength=association.count)
    middle = np.cumsum(number) - number + number // 2
    witness = np.zeros(association.count, dtype=np.int64)
    witness[number > 0] = keyframe[order][middle[number > 0]]
    return witness
