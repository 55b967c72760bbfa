"""Estimate the errors that all measurements share, around the joint solve, by variable projection (Golub and Pereyra 1973).

An outer Gauss-Newton step moves the parameters. An inner solve then fits poses and landmarks to the new measurements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.noise import NOMINAL, NoiseFactors
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.correlated_errors import correlation_factors
from objslam.graph.calibration.information import covariance_of, likelihood, without_shrinking
from objslam.graph.calibration.inner_solve import InnerSolve
from objslam.graph.calibration.localization_noise import noise_of_localization, without_localization
from objslam.graph.calibration.noise_in_instruments import noise_shares
from objslam.graph.calibration.prior_conflict import with_wider_priors
from objslam.graph.calibration.shared_error_jacobian import LinearSystem, ReducedSystem, linearise
from objslam.graph.calibration.variance_components import estimate_noise
from objslam.graph.least_squares.anderson import MEMORY, accelerated
from objslam.graph.outlier_rejection import JointSolution, known_landmarks, misfit, reject_outliers

_ROUNDS = 8
"""The most outer steps of a search. The MRCLAM robots, whose clocks are 0.2 s off, take 1 or 2 steps before the noise is
known, and 1 or 2 after. A larger number is slower."""
_CONVERGED = 0.2
"""The step of a parameter, in posterior standard deviations, below which it has converged. A larger step ends sooner."""
_NEARLY = 2.0
"""The limit that replaces `_CONVERGED` before the noise is known. The search goes on with the new noise, so its first part
may end near the optimum. A larger limit ends this part sooner, but the residuals that give the noise then contain more of
the shared errors."""
_HALVINGS = 3
"""The most times that a step that does not lower the cost is halved. A larger number tries shorter steps. If no step lowers
the cost, the parameters stay as they are."""
_KEPT = 0.8
"""The least ratio of the number of agreeing rays after a step, or with a new noise, to the number before. Below this ratio,
the step is halved, or the noise is refused. The rays of moving things fit no place. They can move a solve far from the other
rays, so that it loses one ray after another. Right steps of recorded robots kept 0.99, and wrong steps of a robot among
others kept 0.77 and less. A smaller ratio refuses fewer steps."""
_NOISE_ROUNDS = 3
"""The most estimations of the noise, each followed by a solve with it. Later rounds are slower and change the noise less."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which the noise is not estimated again. A larger change ends sooner."""

_SAME_SHARES = 0.5
"""The relative change of the noise above which the shares of noise in the information (`noise_shares`) are computed again.
These shares change slowly with the noise. With a larger change, they are computed less often."""

Measure = Callable[[Keyframes, Rays, Settings], Measurements]
"""A function that collects the measurements of keyframes and rays with the noise of the settings."""


@dataclass(frozen=True)
class CalibratedSolution:
    """A joint solution at the shared errors and the noise that fit best.

    errors: the measurements with this noise. measured: the measurements at the shared errors. found: the joint solution.
    sensitivity: (N, 3, P) the derivatives of the landmarks, m per unit of each parameter, NaN for a landmark outside the
    graph.
    """

    calibration: Calibration
    errors: CalibratedMeasurements
    measured: Measurements
    found: JointSolution
    sensitivity: Floats


def calibrate(
    errors: CalibratedMeasurements,
    measure: Measure,
    association: Association,
    found: JointSolution,
    theta: Floats,
    trace: Trace | None = None,
) -> CalibratedSolution:
    """Estimate the shared errors and the noise. The search starts at the joint solution `found` at theta (P,).

    The inliers are tested again after each step. A parameter that the log does not determine stays at its prior.

    Raises:
        SolveError: a linear system has no single solution.
    """
    fit = _Fit(errors, measure, trace)
    state = InnerSolve(measure(*errors.at(theta)), association, found.map_T_camera, found.positions, found.used)
    state = state.ordered(found.near)
    nearly = bool(errors.unknown_noise) and len(theta) > 0 and errors.noise == NOMINAL  # Else, the noise is known.
    at = fit.shared_errors(state, theta, _NEARLY if nearly else _CONVERGED)
    state, theta, steps = at.state, at.theta, at.steps
    for _ in range(_NOISE_ROUNDS if errors.unknown_noise else 0):
        noise = _noise_of_measurements(fit, state, at.system, theta)
        before, same = fit.errors.noise, noise.like(fit.errors.noise, _SAME_NOISE)
        other = replace(fit, errors=fit.errors.with_noise(noise))
        settled = other.remeasured(state, theta)
        if nearly or not same:  # Otherwise, the last solve below settles what little the new noise moves.
            settled = settled.fresh().solved().settled()
            if settled.used.sum() < _KEPT * state.used.sum():
                break
            at = other.shared_errors(settled, theta, _CONVERGED, at.noise if noise.like(before, _SAME_SHARES) else None)
            settled, theta, steps, nearly = at.state, at.theta, steps + at.steps, False
        fit, state = other, settled
        if same:
            break
    if len(theta):
        fit = replace(fit, wider=correlation_factors(at.state, at.system))
        first = at.system if state is at.state else None  # Wider deviations do not change the linear system.
        at = fit.shared_errors(state, theta, _CONVERGED, at.noise, first)
        state, theta, steps = at.state, at.theta, steps + at.steps
    nothing = np.zeros(len(state.used), dtype=bool)
    near = state.landmarks, state.factored
    final = reject_outliers(
        state.measured, association, state.map_T_camera, state.positions, state.used, nothing, trace, near=near, close=True
    )
    covariance, sensitivity = np.zeros((0, 0)), np.full((association.count, 3, len(theta)), np.nan)
    if len(theta):
        state, system, reduced = at.state, at.system, at.reduced
        # The last solve of the same rays ends so close that the derivatives are the same.
        if reduced is None or not (
            np.array_equal(final.used, state.used) and np.array_equal(known_landmarks(final.positions), state.landmarks)
        ):
            inliers = InnerSolve(state.measured, association, final.map_T_camera, final.positions, final.used)
            state = inliers.ordered(final.near)
            system = linearise(state, fit.errors, theta, at.noise)
            reduced = without_shrinking(state, system.reduce(), fit.errors, theta)
        covariance = covariance_of(reduced, np.asarray(np.linalg.inv(errors.prior)), correlation_factors(state, system))
        by_landmark = (len(state.landmarks), 3, len(theta))
        sensitivity[state.landmarks] = reduced.sensitivity[: 3 * len(state.landmarks)].reshape(by_landmark)
    final = replace(final, cost_before=found.cost_before, iterations=found.iterations + steps + final.iterations)
    calibration = Calibration(errors.names, theta, covariance, np.sqrt(np.diagonal(errors.prior)))
    calibration = with_wider_priors(calibration, errors.mean, errors.prior)
    return CalibratedSolution(calibration, fit.errors, state.measured, final, sensitivity)


def misfit_at_shared_errors(
    errors: CalibratedMeasurements, measure: Measure, association: Association, found: JointSolution, theta: Floats
) -> float:
    """Return the misfit of a joint solution at the shared errors that fit it best.

    The squared deviations of the shared errors from their priors are added. The misfit compares solutions at the noise of
    `errors`. The search starts at theta (P,). SolveError as in `calibrate`.
    """
    state = InnerSolve(measure(*errors.at(theta)), association, found.map_T_camera, found.positions, found.used)
    at = _Fit(errors, measure, None).shared_errors(state.ordered(found.near), theta, _NEARLY)
    off = at.theta - errors.mean
    rays = misfit(at.state.map_T_camera, at.state.positions, at.state.measured, association)
    return rays + float(off @ np.linalg.solve(errors.prior, off)) if len(off) else rays


def _noise_of_measurements(fit: _Fit, state: InnerSolve, system: LinearSystem, theta: Floats) -> NoiseFactors:
    """Return the noise of all kinds of measurements. system: the linear system of the state at shared errors theta (P,).

    If the noise of the localisation is unknown too, a graph without the localisation gives the noise of the other kinds. In
    a graph with the localisation, poses that err for seconds would look like noise of the rays, and rays that seem noisy
    would hide how much the poses err.
    """
    errors, prior = fit.errors, fit.prior_residuals
    if "localization" not in errors.unknown_noise:
        return estimate_noise(state, system, errors, theta, prior)
    rest = without_localization(state)  # Made once, because its normal equations take long.
    if errors.unknown_noise > {"localization"}:
        noise = estimate_noise(rest, linearise(rest, errors, theta), errors, theta, prior)
    else:
        noise = estimate_noise(state, system, errors, theta, prior)
    return noise_of_localization(rest, errors.with_noise(noise), theta)


@dataclass(frozen=True)
class _Found:
    """The parameters theta (P,) that fit best, and the solution at them.

    system: the linear system at the solution. reduced: the system with poses and landmarks eliminated, None without
    parameters. noise: (P, P) from `noise_shares`. steps: the number of outer steps.
    """

    theta: Floats
    state: InnerSolve
    system: LinearSystem
    reduced: ReducedSystem | None
    noise: Floats
    steps: int


@dataclass(frozen=True)
class _Outer:
    """The state of the search for the shared errors theta (P,).

    linear: the linear system. system: the same with poses and landmarks eliminated. gradient: (P,) minus the gradient of the
    negative log-likelihood. information: (P, P) of the likelihood. curvature: (P, P) the information plus that of the prior.
    step: (P,) the Gauss-Newton step.
    """

    state: InnerSolve
    theta: Floats
    linear: LinearSystem
    system: ReducedSystem
    gradient: Floats
    information: Floats
    curvature: Floats
    step: Floats

    @cached_property
    def deviations(self) -> Floats:
        """(P,) the standard deviations of the parameters."""
        return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(self.curvature))))

    @property
    def left(self) -> float:
        """The decrease of the cost that the linear system predicts for the step."""
        return float(self.step @ self.curvature @ self.step) / 2

    def converged(self, step: Floats, share: float) -> bool:
        """Return whether each step (P,) is below this share of the standard deviation of its parameter."""
        return bool((np.abs(step) < share * self.deviations).all())

    def cost_of_signal(self, cost: float, other: Floats) -> float:
        """Return a cost at other parameters (P,), without the bias by the noise of the odometry."""
        moved = other - self.theta
        bent = self.system.information - self.information
        return float(cost - (self.gradient - self.system.descent) @ moved - moved @ bent @ moved / 2)


@dataclass(frozen=True)
class _Fit:
    """The input of a search for shared errors: the measurements as a function of the errors.

    wider: (P,) factors on the standard deviations of the gradient, for noise that is not white, None until they are known.
    They are computed only at parameters that fit, because wrong parameters also cause correlated residuals.
    """

    errors: CalibratedMeasurements
    measure: Measure
    trace: Trace | None
    wider: Floats | None = None

    @property
    def prior_residuals(self) -> float:
        """The weight of the nominal noise, as a number of residuals."""
        return self.errors.settings.noise.prior

    def shared_errors(
        self,
        state: InnerSolve,
        theta: Floats,
        converged: float,
        noise: Floats | None = None,
        first: LinearSystem | None = None,
    ) -> _Found:
        """Return the parameters that fit best. The search starts at theta (P,).

        converged: the number of posterior standard deviations below which a step ends the search. noise: (P, P) from
        `noise_shares`, if known. first: the linear system at the start, if known.
        """
        errors = self.errors
        prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
        sigma = np.sqrt(np.diagonal(errors.prior))
        if len(theta) == 0:
            return _Found(theta, state, linearise(state, errors, theta), None, theta, 0)

        def deviation(values: Floats) -> float:
            """Return half the squared Mahalanobis distance of parameters (P,) from their prior."""
            return float((values - errors.mean) @ prior @ (values - errors.mean)) / 2

        first = linearise(state, errors, theta) if first is None else first
        shares = noise_shares(state, first, errors) if noise is None else noise

        def outer(state: InnerSolve, theta: Floats, linear: LinearSystem) -> _Outer:
            linear = linear.with_noise(shares)
            system = without_shrinking(state, linear.reduce(), errors, theta)
            weights, information = likelihood(system.with_wider(self.wider))
            gradient = weights @ system.gradient
            step = np.linalg.solve(information + prior, gradient - prior @ (theta - errors.mean))
            return _Outer(state, theta, linear, system, gradient, information, information + prior, np.asarray(step))

        now, history, steps = outer(state, theta, first), list[tuple[Floats, Floats]](), 0
        fewest = _KEPT * state.used.sum()
        while steps < _ROUNDS and not now.converged(now.step, converged):
            history = [*history[-MEMORY:], (now.theta, now.step)]
            target = accelerated(history, sigma)
            before, better = now.state.cost + deviation(now.theta), None
            for _ in range(_HALVINGS + 1):
                other = np.clip(target, -errors.bounds, errors.bounds)
                trial = now.state.predicted(now.system, other - now.theta, self.measure(*errors.at(other))).solved()
                settled = trial.settled()
                after = outer(settled, other, linearise(settled, errors, other))
                # The noise of the odometry makes the cost rugged along the clocks. There, the gradient tells more.
                lower = now.cost_of_signal(trial.cost + deviation(other), other) <= before or after.left < now.left / 2
                if lower and settled.used.sum() >= fewest:
                    better = after
                    break
                target, history = now.theta + (target - now.theta) / 2, []
                if now.converged(target - now.theta, converged):
                    break
            if better is None:
                break
            now, steps = better, steps + 1
            if self.trace is not None:
                self.trace.base_T_camera = now.state.measured.keyframes.base_T_camera
                shown = Parameters(errors.names, now.theta, now.deviations)
                self.trace.iteration("solve", now.state.cost, now.state.map_T_camera, now.state.positions, shown)
        return _Found(now.theta, now.state, now.linear, now.system, shares, steps)

    def remeasured(self, state: InnerSolve, theta: Floats) -> InnerSolve:
        """Return the same poses and landmarks with the measurements at the present noise."""
        return state.measuring(self.measure(*self.errors.at(theta)))
