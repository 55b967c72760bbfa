"""What a joint solution shows about the shared errors that it held, and what these errors do to it.

One outer step of `self_calibration` is enough to see whether a held error is large. It takes a tenth of the time of a solve.
"""

from dataclasses import replace

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


def predict(errors: CalibratedMeasurements, association: Association, estimate: Estimate, theta: Floats) -> Calibration:
    """Return the shared errors after one Gauss-Newton step from a solution, with their covariance.

    A held error bends the path, so it correlates the residuals, and its effect on the odometry looks like noise. So the step
    takes the residuals for white noise. Otherwise the step would be only a third as long. The covariance is for white noise
    too.

    errors: the estimated and the held errors of the same keyframes and rays, at the noise of the solution. theta: (P,) their
    values in the solution. SolveError if the linear system is not finite.
    """
    _, reduced = _reduced(errors, association, estimate, theta)
    step, covariance = _step(reduced, errors, theta)
    return Calibration(errors.names, theta + step, covariance, np.sqrt(np.diagonal(errors.prior)))


def moved_by_held(
    errors: CalibratedMeasurements, association: Association, estimate: Estimate, theta: Floats, held: Bools
) -> Floats:
    """Return how far the held errors may move landmarks: a factor (N, 3, H), m, of their joint covariance (consider
    covariance; Schmidt 1966).

    The estimated errors take up a part of a held error. A held error has the variance of its prior, because real noise is
    not white, and bends the path as a held error does. The square of a step that `predict` returns is added, as the solution
    does not follow it. Landmarks outside the graph do not move.

    held: (P,) which errors the solution held. The other parameters and SolveError are as in `predict`.
    """
    state, reduced = _reduced(errors, association, estimate, theta)
    step, _ = _step(reduced, errors, theta)
    free, slope = ~held, reduced.slope
    # The solve weighed the gradients by the estimated errors alone, without those by the held ones.
    own = np.ix_(free, free)
    weights, information = likelihood(replace(reduced, slope=slope[own], variance=reduced.variance[own]))
    curvature = information + np.linalg.inv(errors.prior[own])
    along = np.zeros((len(held), int(held.sum())))
    along[held] = np.eye(along.shape[1])
    along[free] = -np.linalg.solve(curvature, weights @ slope[np.ix_(free, held)])
    along *= np.sqrt(np.diagonal(errors.prior) + step**2)[held]
    moved = np.zeros((association.count, 3, along.shape[1]))
    by_landmark = reduced.sensitivity[: 3 * len(state.landmarks)] @ along
    moved[state.landmarks] = by_landmark.reshape(len(state.landmarks), 3, along.shape[1])
    return moved


def _reduced(
    errors: CalibratedMeasurements, association: Association, estimate: Estimate, theta: Floats
) -> tuple[InnerSolve, ReducedSystem]:
    """Return the state of a solution, and its linear system with poses and landmarks eliminated."""
    multiframes = Multiframes.of(errors.keyframes)
    keyframes, rays, settings = errors.at(theta)
    ties = find_ties(multiframes.keyframes(keyframes), settings)
    rays = share_bias(rays, association)
    measured = Measurements.of(keyframes, rays, settings, multiframes, None, ties)
    map_T_camera = (estimate.map_T_base @ keyframes.base_T_camera)[multiframes.first]
    used = (estimate.weight > 0) & (association.object >= 0)
    state = InnerSolve(measured, association, map_T_camera, estimate.positions, used).ordered(None)
    return state, without_shrinking(state, linearise(state, errors, theta).reduce(), errors, theta)


def _step(system: ReducedSystem, errors: CalibratedMeasurements, theta: Floats) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step (P,) from theta (P,), and the covariance (P, P) after it."""
    prior = np.asarray(np.linalg.inv(errors.prior))
    weights, information = likelihood(system)
    covariance = np.asarray(np.linalg.inv(information + prior))
    return covariance @ (weights @ system.gradient - prior @ (theta - errors.mean)), covariance
