"""Show from a joint solution whether the shared errors that it held are large, and how far they may move the landmarks.

A solution holds an error if it does not estimate this error. One outer step of `self_calibration` is enough to see whether a
held error is large. The step takes a tenth of the time of a solve.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.estimate import Estimate
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.information import likelihood, without_shrinking
from objslam.graph.calibration.inner_solve import InnerSolve
from objslam.graph.calibration.shared_error_jacobian import ReducedSystem, linearise
from objslam.graph.factors.odometry_motions import find_ties
from objslam.graph.factors.range import share_bias
from objslam.graph.multiframes import Multiframes


@dataclass(frozen=True)
class NextStep:
    """The next Gauss-Newton step of the shared errors after a joint solution.

    errors: the estimated and the held errors of the same keyframes and rays, at the noise of the solution. theta: (P,) the
    values of all errors in the solution. state: the solution. reduced: the linear system of the solution, with poses and
    landmarks eliminated.
    """

    errors: CalibratedMeasurements
    theta: Floats
    state: InnerSolve
    reduced: ReducedSystem

    @classmethod
    def of(cls, errors: CalibratedMeasurements, association: Association, estimate: Estimate, theta: Floats) -> Self:
        """Linearise the solution `estimate` at the shared errors theta (P,). SolveError if its linear system is singular."""
        multiframes = Multiframes.of(errors.keyframes)
        keyframes, rays, settings = errors.at(theta)
        ties = find_ties(multiframes.keyframes(keyframes), settings)
        rays = share_bias(rays, association)
        measured = Measurements.of(keyframes, rays, settings, multiframes, None, ties)
        map_T_camera = (estimate.map_T_base @ keyframes.base_T_camera)[multiframes.first]
        used = (estimate.weight > 0) & (association.object >= 0)
        state = InnerSolve(measured, association, map_T_camera, estimate.positions, used).ordered(None)
        return cls(errors, theta, state, linearise(state, errors, theta).reduce())

    def only(self, errors: CalibratedMeasurements) -> Self | None:
        """Return the step of some of the errors. Return None if another error is not 0, because it changes the
        measurements."""
        columns = np.array([self.errors.names.index(name) for name in errors.names], dtype=np.int64)
        if np.delete(self.theta, columns).any():
            return None
        return replace(self, errors=errors, theta=self.theta[columns], reduced=self.reduced.take(columns))

    def predicted(self) -> Calibration:
        """Return the shared errors after the step, with their covariance.

        A held error bends the path. This correlates the residuals, and looks like noise of the odometry. So the step treats
        the residuals as white noise. Otherwise the step would be only a third as long. The covariance also assumes white
        noise. SolveError if the linear system is not finite.
        """
        step, covariance = self._step(self._without_shrinking())
        return Calibration(self.errors.names, self.theta + step, covariance, np.sqrt(np.diagonal(self.errors.prior)))

    def moved_by(self, held: Bools) -> Floats:
        """Return the moves (N, 3, H), m, of the N landmarks if each of the H held errors changes by one standard deviation.

        The moves F, with the landmarks as rows, give the joint covariance F F^T of the landmarks due to the held errors
        (consider covariance; Schmidt 1966). If a held error is wrong, the estimated errors take up a part of it. The
        variance of a held error is that of its prior, plus the square of the step, because the solution does not take this
        step. The data would give a smaller variance, but their noise is not white, and bends the path as a held error does.
        Landmarks outside the graph do not move.

        held: (P,) the mask of the errors that the solution held. SolveError as in `predicted`.
        """
        errors, state, reduced = self.errors, self.state, self._without_shrinking()
        step, _ = self._step(reduced)
        free, slope = ~held, reduced.slope
        # The solve used only the gradients by the estimated errors, and not the gradients by the held errors.
        own = np.ix_(free, free)
        weights, information = likelihood(replace(reduced, slope=slope[own], variance=reduced.variance[own]))
        curvature = information + np.linalg.inv(errors.prior[own])
        along = np.zeros((len(held), int(held.sum())))
        along[held] = np.eye(along.shape[1])
        along[free] = -np.linalg.solve(curvature, weights @ slope[np.ix_(free, held)])
        along *= np.sqrt(np.diagonal(errors.prior) + step**2)[held]
        moved = np.zeros((state.association.count, 3, along.shape[1]))
        by_landmark = reduced.sensitivity[: 3 * len(state.landmarks)] @ along
        moved[state.landmarks] = by_landmark.reshape(len(state.landmarks), 3, along.shape[1])
        return moved

    def _without_shrinking(self) -> ReducedSystem:
        return without_shrinking(self.state, self.reduced, self.errors, self.theta)

    def _step(self, system: ReducedSystem) -> tuple[Floats, Floats]:
        """Return the step (P,), and the covariance (P, P) after it."""
        prior = np.asarray(np.linalg.inv(self.errors.prior))
        weights, information = likelihood(system)
        covariance = np.asarray(np.linalg.inv(information + prior))
        return covariance @ (weights @ system.gradient - prior @ (self.theta - self.errors.mean)), covariance
