"""Estimate the errors that all measurements share, around the joint solve: variable projection (Golub and Pereyra 1973).

An outer Gauss-Newton step moves the parameters. An inner solve then fits poses and landmarks to the new measurements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration, kind
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.anderson import MEMORY, accelerated
from objslam.graph.calibration.correlated_errors import correlation_factors
from objslam.graph.calibration.inner_solve import InnerSolve
from objslam.graph.calibration.shared_error_jacobian import LinearSystem, ReducedSystem, linearise
from objslam.graph.calibration.variance_components import estimate_noise, shrinking_force
from objslam.graph.outlier_rejection import JointSolution, reject_outliers

_ROUNDS = 8
"""The most outer steps of a search. The MRCLAM robots, whose clocks are 0.2 s off, take 1 or 2 steps before the noise is
known, and 1 or 2 after. A larger number is slower."""
_CONVERGED = 0.2
"""A parameter has converged if its step is below this many posterior standard deviations. A larger number ends sooner."""
_NEARLY = 2.0
"""The same before the noise is known. The search goes on with the new noise, so its first part may end near the optimum. A
larger number ends it sooner, but then the residuals from which the noise is estimated contain more of the shared errors."""
_HALVINGS = 3
"""The most times that a step is halved if it does not lower the cost. A larger number tries shorter steps. If no step lowers
the cost, the parameters stay as they are."""
_LEAST_SIGNAL = 0.05
"""The least share of signal in the information about a clock or odometry scale. A smaller share takes larger steps."""
_RIDGE = 1e-9
"""The share of the information about the clocks that is added to its diagonal. It prevents a division by zero if a log
cannot tell two clocks apart. A larger share mixes such clocks more."""

_NOISE_ROUNDS = 3
"""The most estimations of the noise, each followed by a solve with it. Later rounds are slower and change the noise less."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which it is not estimated again. A larger value ends sooner."""

_SAME_SHARES = 0.5
"""The relative change of the noise below which the shares of noise in the information stay as they were. These shares change
slowly with the noise, and take two inner solves for each clock. A larger value measures them less often."""

_LEAST_GROWTH = 0.5
"""The common scale is projected out only if the linearised map grows by more than this share when all unknown scales grow by
1. An exact map would grow by 1. With a larger value, the projection is used more rarely."""
_FAR = 3.0
"""Landmarks up to this multiple of the median distance from the middle of the map show its size. With a larger value, poorly
determined landmarks count too."""
_SHRINKINGS = 30
"""The most reductions of the noise in the information until the curvature is positive. More reductions keep less noise."""

Measure = Callable[[Keyframes, Rays, Settings], Measurements]
"""A function that collects the measurements of keyframes and rays with the noise of the settings."""


@dataclass(frozen=True)
class CalibratedSolution:
    """A joint solution at the shared errors and the noise that fit best.

    errors: the measurements with this noise. sensitivity: (N, 3, P) of the landmarks, m per unit of each parameter, NaN for
    a landmark outside the graph.
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
    """Estimate the shared errors and the noise from a joint solution at `theta` (P,).

    The inliers are tested again after each step. A parameter that the log does not determine stays at its prior.

    Raises:
        SolveError: a linear system has no single solution.
    """
    fit = _Fit(errors, measure, trace)
    state = InnerSolve(measure(*errors.at(theta)), association, found.map_T_camera, found.positions, found.used).ordered()
    nearly = bool(errors.unknown_noise) and len(theta) > 0
    at = fit.shared_errors(state, theta, _NEARLY if nearly else _CONVERGED)
    state, theta, steps = at.state, at.theta, at.steps
    for _ in range(_NOISE_ROUNDS if errors.unknown_noise else 0):
        noise = estimate_noise(state, at.system, fit.errors, theta, fit.prior_residuals)
        before, same = fit.errors.noise, noise.like(fit.errors.noise, _SAME_NOISE)
        fit = replace(fit, errors=fit.errors.with_noise(noise))
        state = fit.remeasured(state, theta).settled()
        if nearly or not same:
            at = fit.shared_errors(state, theta, _CONVERGED, at.noisy if noise.like(before, _SAME_SHARES) else None)
            state, theta, steps, nearly = at.state, at.theta, steps + at.steps, False
        if same:
            break
    nothing = np.zeros(len(state.used), dtype=bool)
    final = reject_outliers(state.measured, association, state.map_T_camera, state.positions, state.used, nothing, trace)
    state = InnerSolve(state.measured, association, final.map_T_camera, final.positions, final.used).ordered()
    system = linearise(state, fit.errors, theta)
    reduced = _without_shrinking(state, system.reduce(), fit.errors, theta)
    prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
    _, covariance = _curvature(reduced.information, at.noisy, prior, correlation_factors(state, system))
    sensitivity = np.full((association.count, 3, len(theta)), np.nan)
    by_landmark = (len(state.landmarks), 3, len(theta))
    sensitivity[state.landmarks] = reduced.sensitivity[: 3 * len(state.landmarks)].reshape(by_landmark)
    final = replace(final, cost_before=found.cost_before, iterations=found.iterations + steps + final.iterations)
    calibration = Calibration(errors.names, theta, covariance, np.sqrt(np.diagonal(errors.prior)))
    return CalibratedSolution(calibration, fit.errors, state.measured, final, sensitivity)


@dataclass(frozen=True)
class _Found:
    """The parameters theta (P,) that fit best, and the solution at them.

    system: the linear system at the solution. noisy: (P, P) from `noise_shares`. steps: the number of outer steps.
    """

    theta: Floats
    state: InnerSolve
    system: LinearSystem
    noisy: Floats
    steps: int


@dataclass(frozen=True)
class _Fit:
    """The input of a search for shared errors: the measurements as a function of the errors."""

    errors: CalibratedMeasurements
    measure: Measure
    trace: Trace | None

    @property
    def prior_residuals(self) -> float:
        """The weight of the nominal noise: it counts like this number of residuals."""
        return self.errors.settings.noise.prior

    def shared_errors(self, state: InnerSolve, theta: Floats, converged: float, noisy: Floats | None = None) -> _Found:
        """Return the parameters that fit best. The search starts at theta (P,).

        converged: the number of posterior standard deviations below which a step ends the search. noisy: from
        `noise_shares`, if known.
        """
        errors = self.errors
        prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
        sigma = np.sqrt(np.diagonal(errors.prior))
        if len(theta) == 0:
            return _Found(theta, state, linearise(state, errors, theta), errors.prior, 0)

        def deviation(values: Floats) -> float:
            """Return half the squared Mahalanobis distance of parameters (P,) from their prior."""
            return float((values - errors.mean) @ prior @ (values - errors.mean)) / 2

        history: list[tuple[Floats, Floats]] = []
        steps = 0
        while True:
            linear = linearise(state, errors, theta)
            system = _without_shrinking(state, linear.reduce(), errors, theta)
            noisy = self.noise_shares(state, system, theta) if noisy is None else noisy
            if steps == _ROUNDS:
                break
            curvature, covariance = _curvature(system.information, noisy, prior)
            step = np.asarray(np.linalg.solve(curvature, system.gradient - prior @ (theta - errors.mean)), dtype=np.float64)
            pull = system.gradient - system.descent
            deviations = np.sqrt(np.diagonal(covariance))
            if (np.abs(step) < converged * deviations).all():
                break
            history = [*history[-MEMORY:], (theta, step)]
            target = accelerated(history, sigma)
            before, better = state.cost + deviation(theta), None
            for _ in range(_HALVINGS + 1):
                other = np.clip(target, -errors.bounds, errors.bounds)
                trial = state.predicted(system, other - theta, self.measure(*errors.at(other))).solved()
                if trial.cost + deviation(other) - pull @ (other - theta) <= before:
                    better = trial
                    break
                target, history = theta + (target - theta) / 2, []
                if (np.abs(target - theta) < converged * deviations).all():
                    break
            if better is None:
                break
            theta, state, steps = other, better.settled(), steps + 1
            if self.trace is not None:
                self.trace.base_T_camera = state.measured.keyframes.base_T_camera
                moved = Parameters(errors.names, theta, deviations)
                self.trace.iteration("solve", state.cost, state.map_T_camera, state.positions, moved)
        return _Found(theta, state, linear, noisy, steps)

    def noise_shares(self, state: InnerSolve, system: ReducedSystem, theta: Floats) -> Floats:
        """Return the part (P, P) of the information that comes from noise. Entry i, j is divided by sqrt(I_ii I_jj).

        Only clocks and odometry scales have such a part. The derivative of a motion by a clock is a difference of measured
        velocities. The noise of the velocities is in the Jacobian, and makes its square too large. But the noise does not
        affect the change of the gradient between two values of the clock. The clocks of several cameras share this noise.
        """
        noisy = np.diag(1 - np.maximum(system.signal, _LEAST_SIGNAL))
        clocks = np.flatnonzero([kind(name) == "clock" for name in self.errors.names])
        if not len(clocks):
            return noisy
        change = np.zeros((len(clocks), len(clocks)))
        for i, k in enumerate(clocks.tolist()):
            step = self.errors.steps[k] * np.eye(len(theta))[k]
            ahead, behind = (self.gradient(state, system, theta, at, clocks.tolist()) for at in (step, -step))
            change[:, i] = (behind - ahead) / (2 * self.errors.steps[k])
        scale = np.sqrt(np.maximum(np.diagonal(system.information)[clocks], 1e-300))
        block = np.ix_(clocks, clocks)
        whole = system.information[block] / np.outer(scale, scale) + _RIDGE * np.eye(len(clocks))
        root = np.linalg.cholesky(whole)
        told = np.linalg.solve(root, np.linalg.solve(root, change / np.outer(scale, scale)).T)
        size, axes = np.linalg.eigh((told + told.T) / 2)
        lost = root @ (axes * (1 - np.clip(size, _LEAST_SIGNAL, 1.0)))
        noisy[block] = lost @ (root @ axes).T
        return noisy

    def gradient(self, state: InnerSolve, system: ReducedSystem, theta: Floats, step: Floats, which: list[int]) -> Floats:
        """Return the gradient by the parameters `which` (indices) at the optimum after a step (P,) of all parameters."""
        side = state.predicted(system, step, self.measure(*self.errors.at(theta + step))).solved()
        return linearise(side, self.errors, theta + step, which).reduce().gradient

    def remeasured(self, state: InnerSolve, theta: Floats) -> InnerSolve:
        """Return the optimum for the measurements with the present noise."""
        return state.measuring(self.measure(*self.errors.at(theta))).solved()


def _curvature(information: Floats, noisy: Floats, prior: Floats, wider: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Return the curvature (P, P) of the profile of the cost, and the covariance (P, P) of the parameters.

    noisy: (P, P) from `_Fit.noise_shares`, the noise in the information. The curvature comes from the signal alone, but the
    variance of the gradient is the whole information. So the covariance is a sandwich (Huber 1967). It never exceeds the
    covariance of the prior in any direction. wider: (P,) factors on the standard deviations of the gradient, for noise that
    is not white.
    SolveError if the information is not finite.
    """
    if not np.isfinite(information).all():
        raise SolveError("the information about the shared errors is not finite")
    scale = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    noise = noisy * np.outer(scale, scale)
    curvature = information - noise + prior
    for _ in range(_SHRINKINGS):
        if (np.linalg.eigvalsh(curvature) > 0).all():
            break
        noise = 0.8 * noise
        curvature = information - noise + prior
    else:
        curvature = information + prior
    inverse = np.linalg.inv(curvature)
    root = np.linalg.cholesky(prior)
    varies = information * np.outer(wider, wider) + prior
    size, axes = np.linalg.eigh(root.T @ inverse @ varies @ inverse @ root)
    axes = np.linalg.solve(root.T, axes)
    return curvature, np.asarray((axes * np.minimum(size, 1.0)) @ axes.T)


def _without_shrinking(
    state: InnerSolve, system: ReducedSystem, errors: CalibratedMeasurements, theta: Floats
) -> ReducedSystem:
    """Return the system without the force that makes a solution too small, because this force would move the parameters.

    The force acts on a parameter as far as the size of the map depends on the parameter. If all lengths have an unknown
    scale, everything can grow in proportion at no cost. In this case, only the force seems to determine the common scale. So
    the common scale is projected out (the gauge of a free network; Meissl 1969). If some length is known, the force is
    computed and subtracted.
    """
    landmarks = state.positions[state.landmarks]
    if not len(landmarks):
        return system
    away = np.linalg.norm(landmarks - np.median(landmarks, axis=0), axis=1)
    near = away <= _FAR * np.median(away)  # A poorly determined landmark is far off, and does not grow with the map.
    around = landmarks[near] - landmarks[near].mean(axis=0)  # Without the mean, a shift of the map would count as growth.
    moved = system.sensitivity[: landmarks.size].reshape(*landmarks.shape, system.sensitivity.shape[1])[near]
    size = np.einsum("ni,nip->p", around, moved) / max(float((around**2).sum()), 1e-12)
    scaled = state.measured.tags is not None and bool(np.isfinite(state.measured.tags.side).any())
    unknown = frozenset() if scaled else errors.unknown_scales  # Fiducials of known size tell the scale.
    growing = np.where([name in unknown for name in errors.names], 1 + theta, 0.0)
    if not growing @ size > _LEAST_GROWTH:
        return replace(system, gradient=system.gradient + shrinking_force(state)[0] * size)
    project = np.eye(len(theta)) - np.outer(size, growing) / (growing @ size)
    return replace(system, gradient=project @ system.gradient, information=project @ system.information @ project.T)
