"""Estimate the errors that all measurements share, around the joint solve: variable projection (Golub and Pereyra 1973).

An outer Gauss-Newton step moves the parameters; an inner solve moves poses and landmarks to the measurements that result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration, kind
from objslam.core.geometry import exp_se3
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.anderson import MEMORY, accelerated
from objslam.graph.calibration.correlated_errors import correlation_factors
from objslam.graph.calibration.shared_error_jacobian import Linearised, LinearSystem, ReducedSystem, linearise
from objslam.graph.calibration.variance_components import estimate_noise, shrinking_force
from objslam.graph.optimizers import build_graph, gauss_newton
from objslam.graph.outlier_rejection import JointSolution, reject_outliers, supported
from objslam.graph.variables import make_values, read_poses, with_points

_ROUNDS = 8
"""The most outer steps; more is slower. The MRCLAM robots, whose clocks are 0.2 s off, take 4 to 6."""
_CONVERGED = 0.2
"""The step, in posterior standard deviations, below which a parameter has converged; larger ends sooner."""
_INNER = 3
"""The iterations of an inner solve. Few are enough, because each begins at a linear prediction of its optimum."""
_TOLERANCE = 1e-4
"""The relative decrease of the cost in an iteration below which an inner solve ends. A larger value ends it sooner."""
_HALVINGS = 3
"""How often a step that does not lower the cost is halved before the parameters are left as they are."""
_LEAST_SIGNAL = 0.05
"""The least share of signal in the information about a clock. A smaller share lets a noisy clock move farther in a step."""
_RIDGE = 1e-9
"""The share of the information about the clocks that is added to its diagonal. It keeps clocks that a log cannot tell apart
from a division by zero, and a larger share blurs them."""

_NOISE_ROUNDS = 3
"""How often the noise is estimated, each time followed by a solve with it. More rounds are slower and change it less."""
_SAME_NOISE = 0.1
"""The relative change of the noise below which it is not estimated again. A larger change ends sooner."""

_SAME_SHARES = 0.5
"""The relative change of the noise below which the shares of noise in the information stay as they were. They follow the
noise slowly, and each takes two inner solves for each clock. A larger change measures them more rarely."""

_LEAST_GROWTH = 0.5
"""The least growth of the map by which a projection is trusted, if all scales grow by 1. It is 1 but for errors of
linearisation. A larger value trusts it more rarely."""
_FAR = 3.0
"""The distance from the middle of the map, as a multiple of the median, up to which landmarks tell its size. A larger
value counts more of those that hardly anything places."""
_SHRINKINGS = 30
"""How often the noise in the information is made smaller to keep the curvature positive; more keep less of it."""

Measure = Callable[[Keyframes, Rays, Settings], Measurements]
"""Collect the measurements of keyframes and rays with the noise of the settings."""


@dataclass(frozen=True)
class CalibratedSolution:
    """A joint solution at the shared errors and the noise that fit best.

    errors: with this noise. sensitivity: (N, 3, P) of the landmarks, m per unit of each parameter.
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

    Which rays are used is settled again after each step. What the log does not tell stays at its prior.

    Raises:
        SolveError: a linear system has no single solution.
    """
    fit = _Fit(errors, measure, trace)
    state = _State.of(measure(*errors.at(theta)), association, found.map_T_camera, found.positions, found.used)
    at = fit.shared_errors(state, theta)
    state, theta, steps = at.state, at.theta, at.steps
    for _ in range(_NOISE_ROUNDS if errors.unknown_noise else 0):
        noise = estimate_noise(state, at.system, fit.errors, theta, fit.prior_residuals)
        before, same = fit.errors.noise, noise.like(fit.errors.noise, _SAME_NOISE)
        fit = replace(fit, errors=fit.errors.with_noise(noise))
        state = fit.remeasured(state, theta).settled()
        if same:
            break
        at = fit.shared_errors(state, theta, at.noisy if noise.like(before, _SAME_SHARES) else None)
        state, theta, steps = at.state, at.theta, steps + at.steps
    nothing = np.zeros(len(state.used), dtype=bool)
    final = reject_outliers(state.measured, association, state.map_T_camera, state.positions, state.used, nothing, trace)
    state = _State.of(state.measured, association, final.map_T_camera, final.positions, final.used)
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

    system: of the solution. noisy: (P, P) the shares of noise in the information that the search took. steps: how many it
    took.
    """

    theta: Floats
    state: _State
    system: LinearSystem
    noisy: Floats
    steps: int


@dataclass(frozen=True)
class _Fit:
    """What a search for shared errors needs: the measurements as a function of them."""

    errors: CalibratedMeasurements
    measure: Measure
    trace: Trace | None

    @property
    def prior_residuals(self) -> float:
        """For how many residuals the nominal noise counts."""
        return self.errors.settings.noise.prior

    def shared_errors(self, state: _State, theta: Floats, noisy: Floats | None = None) -> _Found:
        """Return the parameters that fit best, from theta (P,) on. noisy: (P, P) the shares of noise, if they are known."""
        errors = self.errors
        prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
        sigma = np.sqrt(np.diagonal(errors.prior))
        if len(theta) == 0:
            return _Found(theta, state, linearise(state, errors, theta), errors.prior, 0)

        def deviation(values: Floats) -> float:
            """Half the squared Mahalanobis distance of parameters (P,) from their prior."""
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
            if (np.abs(step) < _CONVERGED * deviations).all():
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
                if (np.abs(target - theta) < _CONVERGED * deviations).all():
                    break
            if better is None:
                break
            theta, state, steps = other, better.settled(), steps + 1
            if self.trace is not None:
                self.trace.base_T_camera = state.measured.keyframes.base_T_camera
                moved = Parameters(errors.names, theta, deviations)
                self.trace.iteration("solve", state.cost, state.map_T_camera, state.positions, moved)
        return _Found(theta, state, linear, noisy, steps)

    def noise_shares(self, state: _State, system: ReducedSystem, theta: Floats) -> Floats:
        """Return what noise adds to the information (P, P), as shares of its diagonal: to clocks and odometry scales.

        The derivative of a motion by a clock is a difference of measured velocities. Their noise enters the Jacobian, and
        makes its square too large. It does not enter the change of the gradient between two values of the clock. The clocks
        of several cameras share this noise.
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

    def gradient(self, state: _State, system: ReducedSystem, theta: Floats, step: Floats, which: list[int]) -> Floats:
        """The gradient by some parameters at the optimum for a step (P,) from the parameters."""
        side = state.predicted(system, step, self.measure(*self.errors.at(theta + step))).solved()
        return linearise(side, self.errors, theta + step, which).reduce().gradient

    def remeasured(self, state: _State, theta: Floats) -> _State:
        """The optimum for the measurements with the noise as it is now."""
        measured = self.measure(*self.errors.at(theta))
        return _State.of(measured, state.association, state.map_T_camera, state.positions, state.used).solved()


def _curvature(information: Floats, noisy: Floats, prior: Floats, wider: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Return the curvature (P, P) of the profile of the cost, and the covariance (P, P) of the parameters.

    noisy: (P, P) the noise in the information, as shares of its diagonal. The gradient varies as the whole information says,
    also by this noise, while the curvature is that of the signal alone. Hence the covariance is a sandwich (Huber 1967). In
    no direction is it larger than that of the prior. wider: (P,) factors on the deviations of the gradient, for noise that
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


def _without_shrinking(state: _State, system: ReducedSystem, errors: CalibratedMeasurements, theta: Floats) -> ReducedSystem:
    """Return the system without the force that makes a solution too small, which would pull at the parameters.

    A parameter feels the force as far as the size of the map follows it. If all lengths have an unknown scale, everything
    can grow in proportion at no cost. So what seems to tell a common scale is this force, and it is projected out (the gauge
    of a free network; Meissl 1969). Else the force is measured.
    """
    landmarks = state.positions[state.landmarks]
    if not len(landmarks):
        return system
    away = np.linalg.norm(landmarks - np.median(landmarks, axis=0), axis=1)
    near = away <= _FAR * np.median(away)  # A landmark that hardly anything places is far off, and does not grow along.
    around = landmarks[near] - landmarks[near].mean(axis=0)  # With the mean, a shift of the whole map is no growth.
    moved = system.sensitivity[: landmarks.size].reshape(*landmarks.shape, system.sensitivity.shape[1])[near]
    size = np.einsum("ni,nip->p", around, moved) / max(float((around**2).sum()), 1e-12)
    growing = np.where([name in errors.unknown_scales for name in errors.names], 1 + theta, 0.0)
    if not growing @ size > _LEAST_GROWTH:
        return replace(system, gradient=system.gradient + shrinking_force(state)[0] * size)
    project = np.eye(len(theta)) - np.outer(size, growing) / (growing @ size)
    return replace(system, gradient=project @ system.gradient, information=project @ system.information @ project.T)


@dataclass(frozen=True)
class _State(Linearised):
    """A graph at its optimum for given parameters, and its cost."""

    cost: float

    @classmethod
    def of(
        cls, measured: Measurements, association: Association, map_T_camera: Floats, positions: Floats, used: Bools
    ) -> Self:
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        graph = build_graph(measured.factors(association.object, np.flatnonzero(used), landmarks, positions))
        values = make_values(map_T_camera, positions, landmarks)
        return cls(graph, values, measured, association, map_T_camera, positions, used, graph.error(values))

    def predicted(self, system: ReducedSystem, step: Floats, measured: Measurements) -> Self:
        """The linear prediction of the optimum for other measurements, a step (P,) of the parameters away."""
        landmarks = self.landmarks
        change = system.sensitivity @ step + system.newton
        positions = self.positions.copy()
        positions[landmarks] += change[: 3 * len(landmarks)].reshape(-1, 3)
        map_T_camera = self.map_T_camera @ exp_se3(change[3 * len(landmarks) :].reshape(-1, 6))
        return type(self).of(measured, self.association, map_T_camera, positions, self.used)

    def solved(self) -> Self:
        """The same after a few iterations of the inner solve."""
        optimum = gauss_newton(self.graph, self.values, _INNER, _TOLERANCE)
        return replace(
            self,
            map_T_camera=read_poses(optimum.values),
            positions=with_points(self.positions, self.landmarks, optimum.values),
            values=optimum.values,
            cost=optimum.cost_after,
        )

    def settled(self) -> Self:
        """The same with the rays that agree with their objects now."""
        used = supported(self.measured.rays, self.association, self.map_T_camera, self.positions, self.used)
        if np.array_equal(used, self.used):
            return self
        return type(self).of(self.measured, self.association, self.map_T_camera, self.positions, used)
