"""Solve a whole log in one factor graph: objects at fixed poses, or poses and objects together."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import angles_off
from objslam.core.ground.flattening import flattened_lines, flattened_points, raised_covariances, raised_points
from objslam.core.statistics import widening
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
from objslam.graph.optimizers import build_graph, optimize, trace_solve
from objslam.graph.outlier_rejection import ROUNDS, JointSolution, misfit, reject_outliers, rejected_stretches
from objslam.graph.posterior.joint_estimate import SolvedErrors, estimate_of
from objslam.graph.posterior.marginals import largest_sigma
from objslam.graph.robust_cost import ray_information
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.fixed import tags_at_poses
from objslam.graph.variables import make_values, with_points
from objslam.triangulation.triangulate import Triangulation

_TOLERANCE, _TOLERANCE_BEFORE = 1e-6, 1e-3
"""The smallest share by which an iteration must decrease the cost. Below this share, a joint solve ends. The first value is
for a solve without shared errors. The second value is for a solve with shared errors, because the estimation of the errors
moves all poses and objects again. With larger values, a solve ends sooner."""
_ROUNDS_BEFORE = 2
"""The largest number of rounds of solve and test before the shared errors are estimated. The estimation tests the inliers
after each of its steps. A larger number is slower, and leads to the same inliers."""


def solve_fixed(
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    start: Triangulation,
    settings: Settings,
    trace: Trace | None = None,
) -> Estimate:
    """Estimate the objects at fixed poses, starting from the triangulation. Each inlier ray has one factor.

    The loss `l1` is Eq. 1 of Staszak & Belter. With this loss, the covariances are those of the triangulation. An object
    that only ranges resolve keeps its triangulated position, because Eq. 1 uses no ranges. The other losses weigh the angle
    of each ray by its noise. They add a factor along the ray for each measured range. An object that the triangulation did
    not resolve is not solved.
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
    weight[used] = optimum.ray_weights(loss, residual)
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
    """Estimate poses and objects together.

    The solve starts from the poses of the localisation, or from a graph that grew along the odometry. Each solve is followed
    by a test of all rays. Rays far outside the noise of their object are rejected, and other rays return. An object is added
    or moved if the new poses determine it better. Solve and test repeat until nothing changes. If odometry alone gives the
    poses, and most rays of a stretch of the drive were rejected, the poses of the stretch may be wrong. So the rays of the
    stretch return once. Of the two solutions, the one with the lower cost is the result. Images with the same stamp share
    one pose. Inside the solve, each corner of a fiducial is a landmark, and a factor ties four corners to a square
    (`graph.tags`).

    Args:
        progress: called as progress(done, total) with numbers of keyframes in the growing graph.
        start: (K, 4, 4) the camera poses to start from. If None, the solve starts as described above.
        places: (N, 3) m, positions to start from, NaN where unknown. Give them only if `start` and `places` are the solution
            of nearly the same measurements. If they are given, the rays of rejected stretches do not return.
        errors: the same keyframes and rays as a function of shared errors. If given, the shared errors are estimated. Their
            covariance is added to the covariance of objects.
        theta: (P,) the first values of the shared errors. If None, the solve starts at their mean.
        hold: whether the shared errors stay at theta. If so, the noise also stays, and the objects get no added covariance.

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
    if trace is not None:
        trace.base_T_camera = measured.keyframes.base_T_camera
    begin = None if start is None else start[multiframes.first]
    shared = None if errors is None or theta is None or hold else (errors, measure, theta)
    of_solve = _Solve(measured, association, shared, errors is not None, trace)
    found = of_solve.found(begin, None if tags is not None else places, progress, returns=places is None)
    if errors is None or theta is None:
        return estimate_of(measured, association, found, SolvedErrors(), ledger)
    held = Calibration(errors.names, theta, errors.prior, np.sqrt(np.diagonal(errors.prior)))
    if hold:
        return estimate_of(measured, association, found, SolvedErrors(errors, held), ledger)
    from objslam.graph.calibration.self_calibration import calibrate  # It imports scipy.sparse. No other solve needs it.

    try:
        calibrated = calibrate(errors, measure, association, found, theta, trace)
    except (SolveError, np.linalg.LinAlgError) as error:
        ledger.warn(f"the shared errors could not be estimated, and stay as they were: {error}")
        return estimate_of(measured, association, found, SolvedErrors(errors, held, failed=True), ledger)
    solved_errors = SolvedErrors(calibrated.errors, calibrated.calibration, calibrated.sensitivity)
    return estimate_of(calibrated.measured, association, calibrated.found, solved_errors, ledger)


@dataclass(frozen=True)
class _Solve:
    """A joint solve before its shared errors are estimated.

    shared: the shared errors, the function that makes measurements, and the first values of the errors. None if no shared
    errors are estimated. roughly: whether the log has shared errors, estimated or held. If so, this solve ends sooner.
    """

    measured: Measurements
    association: Association
    shared: tuple[CalibratedMeasurements, Callable[[Keyframes, Rays, Settings], Measurements], Floats] | None
    roughly: bool
    trace: Trace | None

    def found(
        self, start: Floats | None, places: Floats | None, progress: Callable[[int, int], None], *, returns: bool
    ) -> JointSolution:
        """Return the solution with the inliers.

        start: (P, 4, 4) the first camera poses. If None, the first poses come from the localisation or from a growing graph.
        places: (N, 3) m, the first positions, None if unknown. returns: whether the rays of rejected stretches return once.
        """
        measured, keyframes = self.measured, self.measured.keyframes
        map_T_camera = keyframes.map_T_camera if start is None else start
        positions = np.full((self.association.count, 3), np.nan) if start is None or places is None else places
        grown = start is None and not keyframes.localized_every
        if grown:
            map_T_camera, positions = initialize_known(measured, self.association, progress, self.trace)
        close = grown or not returns

        def from_start(map_T_camera: Floats, positions: Floats, trace: Trace | None) -> JointSolution:
            begin = measured, self.association, map_T_camera, positions, self._nothing, self._nothing
            return reject_outliers(*begin, trace, self._tolerance, self._rounds, close=close)

        found = from_start(map_T_camera, positions, self.trace)
        if grown:
            found = MultiStart(measured, self.association, from_start, self._misfit).best(found, self.trace)
        loose = keyframes.odom_T_base is not None and not keyframes.localized_every and returns
        return self._with_returned_stretches(found) if loose else found

    def _with_returned_stretches(self, found: JointSolution) -> JointSolution:
        """Try the rays of rejected stretches again. Return the new solution if its misfit is lower, and else `found`."""
        measured, association, trace = self.measured, self.association, self.trace
        back = rejected_stretches(measured.rays, association, found)
        if not back.any():
            return found
        attempt = trace.aside() if trace is not None else None
        before, other, again = misfit(found.map_T_camera, found.positions, measured, association), found, back
        for limit in (1, self._rounds - 1):  # If returned rays belong to their objects, the misfit falls at once.
            begin = measured, association, other.map_T_camera, other.positions, other.used, again
            tried = reject_outliers(*begin, attempt, self._tolerance, limit, other.near, close=True)
            other, again = replace(tried, iterations=other.iterations + tried.iterations), self._nothing
            if misfit(other.map_T_camera, other.positions, measured, association) >= before:
                return found
        if trace is not None and attempt is not None:
            trace.take(attempt)
        return replace(other, cost_before=found.cost_before)

    def _misfit(self, solution: JointSolution) -> float:
        """Return the misfit of a solution. If shared errors are estimated, they first get the values that fit the solution
        best."""
        if self.shared is None:
            return misfit(solution.map_T_camera, solution.positions, self.measured, self.association)
        from objslam.graph.calibration.self_calibration import misfit_at_shared_errors

        errors, measure, theta = self.shared
        return misfit_at_shared_errors(errors, measure, self.association, solution, theta)

    @property
    def _nothing(self) -> Bools:
        return np.zeros(len(self.measured.rays), dtype=bool)

    @property
    def _tolerance(self) -> float:
        return _TOLERANCE_BEFORE if self.roughly else _TOLERANCE

    @property
    def _rounds(self) -> int:
        return _ROUNDS_BEFORE if self.roughly else ROUNDS


def _distances(origins: Floats, points: Floats) -> Floats:
    """Return the distances (R,) m of points (R, 3) from origins (R, 3), at least `MIN_DEPTH`."""
    return np.maximum(np.linalg.norm(points - origins, axis=1), MIN_DEPTH)
