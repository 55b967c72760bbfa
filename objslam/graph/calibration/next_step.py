"""Predict shared errors from a joint solution that held some of them.

One outer step of `self_calibration` is enough to see whether a held error is large. It takes a tenth of the time of a solve.
"""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import CalibratedMeasurements, Calibration
from objslam.core.estimate import Estimate
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.information import likelihood, without_shrinking
from objslam.graph.calibration.inner_solve import InnerSolve
from objslam.graph.calibration.shared_error_jacobian import linearise
from objslam.graph.factors.odometry_motions import find_ties
from objslam.graph.factors.range import share_bias
from objslam.graph.multiframes import Multiframes


def predict(errors: CalibratedMeasurements, association: Association, estimate: Estimate, theta: Floats) -> Calibration:
    """Return the shared errors after one Gauss-Newton step from a solution, with their covariance.

    A held error bends the path, so it correlates the residuals, and its effect on the odometry looks like noise. So the step
    takes the residuals for white noise. Otherwise the step would be only a third as long. The covariance is also that of
    white noise.

    errors: the estimated and the held errors of the same keyframes and rays, at the noise of the solution. theta: (P,) their
    values in the solution. SolveError if the linear system is not finite.
    """
    multiframes = Multiframes.of(errors.keyframes)
    keyframes, rays, settings = errors.at(theta)
    ties = find_ties(multiframes.keyframes(keyframes), settings)
    rays = share_bias(rays, association)
    measured = Measurements.of(keyframes, rays, settings, multiframes, None, ties)
    map_T_camera = (estimate.map_T_base @ keyframes.base_T_camera)[multiframes.first]
    used = (estimate.weight > 0) & (association.object >= 0)
    state = InnerSolve(measured, association, map_T_camera, estimate.positions, used).ordered(None)
    reduced = without_shrinking(state, linearise(state, errors, theta).reduce(), errors, theta)
    prior = np.asarray(np.linalg.inv(errors.prior))
    weights, information = likelihood(reduced)
    covariance = np.asarray(np.linalg.inv(information + prior))
    step = covariance @ (weights @ reduced.gradient - prior @ (theta - errors.mean))
    return Calibration(errors.names, theta + step, covariance, np.sqrt(np.diagonal(errors.prior)))
