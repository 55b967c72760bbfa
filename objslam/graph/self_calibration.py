"""Estimate the errors that all measurements share, around the joint solve: variable projection (Golub and Pereyra 1973).

An outer Gauss-Newton step moves the parameters; an inner solve moves poses and landmarks to the measurements that result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import gtsam
import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, Calibration, kind
from objslam.core.geometry import exp_se3
from objslam.core.trace import Trace
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.outlier_rejection import JointSolution, reject_outliers, second_opinion
from objslam.graph.shared_error_jacobian import ReducedSystem, reduce_system
from objslam.graph.variables import make_values, read_poses, with_points

_ROUNDS = 8
"""The most outer steps; more is slower. The MRCLAM robots, whose clocks are 0.2 s off, take 4 to 6."""
_CONVERGED = 0.2
"""The step, in posterior standard deviations, below which a parameter has converged; larger ends sooner."""
_INNER = 5
"""The iterations of an inner solve. Few are enough, because each begins at a linear prediction of its optimum."""
_TOLERANCE = 1e-4
"""The relative decrease of the cost in an iteration below which an inner solve ends. A larger value ends it sooner."""
_HALVINGS = 3
"""How often a step that does not lower the cost is halved before the parameters are left as they are."""
_LEAST_SIGNAL = 0.05
"""The least share of signal in the information about a clock. A smaller share lets a noisy clock move farther in a step."""
_MEMORY = 3
"""The steps that Anderson's acceleration looks back on; more extrapolates farther, and less safely."""

Remeasure = Callable[[Floats], Measurements]
"""Return the measurements with shared errors (P,) taken out."""


@dataclass(frozen=True)
class CalibratedSolution:
    """A joint solution at the shared errors that fit best. sensitivity: (N, 3, P) of the landmarks, m per unit."""

    calibration: Calibration
    measured: Measurements
    found: JointSolution
    sensitivity: Floats


def calibrate(
    errors: CalibratedMeasurements,
    remeasure: Remeasure,
    association: Association,
    found: JointSolution,
    theta: Floats,
    trace: Trace | None = None,
) -> CalibratedSolution:
    """Estimate the shared errors from a joint solution at `theta` (P,).

    Which rays are used is settled again after each step. What the log does not tell stays at its prior.

    Raises:
        SolveError: a linear system has no single solution.
    """
    prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
    sigma = np.sqrt(np.diagonal(errors.prior))

    def deviation(values: Floats) -> float:
        """Half the squared Mahalanobis distance of parameters (P,) from their prior."""
        return float((values - errors.mean) @ prior @ (values - errors.mean)) / 2

    state = _State.of(remeasure(theta), association, found.map_T_camera, found.positions, found.used)
    history: list[tuple[Floats, Floats]] = []
    signal: Floats | None = None
    steps = 0
    for _ in range(_ROUNDS):
        system = state.reduced(errors, theta)
        if signal is None:
            signal = _signal_shares(state, system, errors, remeasure, theta)
        curvature, covariance = _curvature(system.information, signal, prior)
        step = np.asarray(np.linalg.solve(curvature, system.gradient - prior @ (theta - errors.mean)), dtype=np.float64)
        if (np.abs(step) < _CONVERGED * np.sqrt(np.diagonal(covariance))).all():
            break
        history = [*history[-_MEMORY:], (theta, step)]
        target = _accelerated(history, sigma)
        before = state.cost + deviation(theta)
        for _ in range(_HALVINGS + 1):
            other = np.clip(target, -errors.bounds, errors.bounds)
            trial = state.moved(system, other - theta, remeasure(other))
            if trial.cost + deviation(other) <= before:
                break
            target, history = theta + (target - theta) / 2, []
        else:
            break
        theta, state, steps = other, trial.settled(), steps + 1
        if trace is not None:
            trace.base_T_camera = state.measured.keyframes.base_T_camera
            trace.iteration("solve", state.cost, state.map_T_camera, state.positions)
    nothing = np.zeros(len(state.used), dtype=bool)
    final = reject_outliers(state.measured, association, state.map_T_camera, state.positions, state.used, nothing, trace)
    state = _State.of(state.measured, association, final.map_T_camera, final.positions, final.used)
    system = state.reduced(errors, theta)
    assert signal is not None
    _, covariance = _curvature(system.information, signal, prior)
    sensitivity = np.full((association.count, 3, len(theta)), np.nan)
    sensitivity[state.landmarks] = system.sensitivity[: 3 * len(state.landmarks)].reshape(-1, 3, len(theta))
    final = replace(final, cost_before=found.cost_before, iterations=found.iterations + steps + final.iterations)
    return CalibratedSolution(Calibration(errors.names, theta, covariance, sigma), state.measured, final, sensitivity)


def _signal_shares(
    state: _State, system: ReducedSystem, errors: CalibratedMeasurements, remeasure: Remeasure, theta: Floats
) -> Floats:
    """Return the shares (P,) of the diagonal of the information that are signal; 1 but for clocks.

    The derivative of a motion by a clock is a difference of measured velocities. Their noise enters the Jacobian, and makes
    its square too large. It does not enter the change of the gradient between two values of the clock.
    """
    shares = np.ones(len(theta))
    for k in np.flatnonzero([kind(name) == "clock" for name in errors.names]).tolist():
        step = errors.steps[k] * np.eye(len(theta))[k]
        sides = [
            state.moved(system, s * step, remeasure(theta + s * step)).reduced(errors, theta + s * step) for s in (1, -1)
        ]
        change = (sides[1].gradient[k] - sides[0].gradient[k]) / (2 * errors.steps[k])
        shares[k] = np.clip(change / max(system.information[k, k], 1e-300), _LEAST_SIGNAL, 1.0)
    return shares


def _curvature(information: Floats, signal: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Return the curvature (P, P) of the profile of the cost, and the covariance (P, P) of the parameters.

    The gradient varies as the whole information says, also by the noise in it, while the curvature is that of the signal
    alone. Hence the covariance is a sandwich (Huber 1967).
    """
    noise = np.diag((1 - signal) * np.diagonal(information))
    curvature = information - noise + prior
    while np.linalg.eigvalsh(curvature)[0] <= 0:
        noise = 0.8 * noise
        curvature = information - noise + prior
    inverse = np.linalg.inv(curvature)
    return curvature, np.asarray(inverse @ (information + prior) @ inverse)


def _accelerated(history: list[tuple[Floats, Floats]], scale: Floats) -> Floats:
    """Return the next parameters (P,) by Anderson's acceleration (Walker and Ni 2011, eq. 2.2) of the Gauss-Newton steps.

    history: parameters and the step from them, the newest last. scale: (P,) in what unit each parameter is compared.
    """
    theta, step = history[-1]
    if len(history) < 2:
        return theta + step
    thetas, steps = (np.diff(np.array(part) / scale, axis=0).T for part in zip(*history, strict=True))
    mix = np.linalg.lstsq(steps, step / scale, rcond=0.05)[0]
    return np.asarray(theta + step - scale * ((thetas + steps) @ mix))


@dataclass(frozen=True)
class _State:
    """A graph at its optimum for given parameters; used: (R,) its rays, cost: the graph's."""

    measured: Measurements
    association: Association
    map_T_camera: Floats
    positions: Floats
    used: Bools
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    cost: float

    @classmethod
    def of(
        cls, measured: Measurements, association: Association, map_T_camera: Floats, positions: Floats, used: Bools
    ) -> Self:
        landmarks = np.flatnonzero(np.isfinite(positions[:, 0]))
        graph = build_graph(measured.factors(association.object, np.flatnonzero(used), landmarks, positions))
        values = make_values(map_T_camera, positions, landmarks)
        return cls(measured, association, map_T_camera, positions, used, graph, values, graph.error(values))

    @property
    def landmarks(self) -> Ints:
        return np.flatnonzero(np.isfinite(self.positions[:, 0]))

    def reduced(self, errors: CalibratedMeasurements, theta: Floats) -> ReducedSystem:
        which = np.flatnonzero(self.used)
        owner = self.association.object[which]
        return reduce_system(
            self.graph, self.values, self.measured, errors, theta, which, owner, self.positions, self.map_T_camera
        )

    def moved(self, system: ReducedSystem, step: Floats, measured: Measurements) -> Self:
        """The optimum for other measurements, from the linear prediction of it for a step (P,) of the parameters."""
        landmarks = self.landmarks
        change = system.sensitivity @ step + system.newton
        positions = self.positions.copy()
        positions[landmarks] += change[: 3 * len(landmarks)].reshape(-1, 3)
        map_T_camera = self.map_T_camera @ exp_se3(change[3 * len(landmarks) :].reshape(-1, 6))
        start = type(self).of(measured, self.association, map_T_camera, positions, self.used)
        optimum = levenberg_marquardt(start.graph, start.values, _INNER, _TOLERANCE)
        return replace(
            start,
            map_T_camera=read_poses(optimum.values),
            positions=with_points(positions, landmarks, optimum.values),
            values=optimum.values,
            cost=optimum.cost_after,
        )

    def settled(self) -> Self:
        """The same with the rays that agree with their objects now."""
        positions, used = second_opinion(self.measured, self.map_T_camera, self.association, self.positions, self.used)
        if np.array_equal(used, self.used):
            return self
        return type(self).of(self.measured, self.association, self.map_T_camera, positions, used)
