"""Compute what a linear system says about the shared errors, after poses and landmarks are eliminated."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import CalibratedMeasurements
from objslam.errors import SolveError
from objslam.graph.calibration.inner_solve import InnerSolve
from objslam.graph.calibration.shared_error_jacobian import ReducedSystem
from objslam.graph.calibration.shrinkage import force_of_heights, shrinking_force

RIDGE = 1e-9
"""The share of the diagonal of a variance or of an information matrix that is added to this diagonal. It prevents a division
by zero if a log cannot tell two parameters apart. A larger share mixes such parameters more."""
_LEAST_GROWTH = 0.5
"""The growth of the linearised map, for a growth of all unknown scales by 1, above which the common scale is projected out.
An exact map would grow by 1. With a larger value, the projection is used more rarely."""
_FAR = 3.0
"""The largest distance of landmarks that show the size of the map, as a multiple of the median distance from the middle of
the map. With a larger value, more of the poorly determined landmarks count."""


def likelihood(system: ReducedSystem) -> tuple[Floats, Floats]:
    """Return the weights (P, P) of the system's gradient, and the information (P, P) that it has about the parameters.

    The gradient is Gaussian. Its mean is the slope C times the error of the parameters, and its variance is V. So the
    weights are C' V^-1 and the information is C' V^-1 C (limited information likelihood; Kim 2002). If the derivatives by
    the parameters have no noise, the weights are 1 and the information is C. If the derivatives are only noise, V is large,
    C is small, and the parameters stay at their prior. SolveError if the system is not finite.
    """
    variance, slope = system.variance, system.slope
    if not (np.isfinite(variance).all() and np.isfinite(slope).all()):
        raise SolveError("the information about the shared errors is not finite")
    size = np.sqrt(np.maximum(np.diagonal(variance), 1e-300))
    scaled = variance / np.outer(size, size) + RIDGE * np.eye(len(size))
    weights = np.linalg.solve(scaled, slope / size[:, None]).T / size
    information = weights @ slope
    return np.asarray(weights), np.asarray((information + information.T) / 2)


def covariance_of(system: ReducedSystem, prior: Floats, wider: Floats) -> Floats:
    """Return the covariance (P, P) of the parameters, at most the covariance of their prior in every direction.

    prior: (P, P) information. wider: (P,) factors on the standard deviations of the gradient, for noise that is not white.
    The factors are known only roughly. So they only widen the result, by the sandwich formula (Huber 1967), and the weights
    stay those for white noise.
    """
    weights, information = likelihood(system)
    inverse = np.linalg.inv(information + prior)
    varies = weights @ system.with_wider(wider).variance @ weights.T + prior
    root = np.linalg.cholesky(prior)
    size, axes = np.linalg.eigh(root.T @ inverse @ varies @ inverse @ root)
    axes = np.linalg.solve(root.T, axes)
    return np.asarray((axes * np.minimum(size, 1.0)) @ axes.T)


def without_shrinking(
    state: InnerSolve, system: ReducedSystem, errors: CalibratedMeasurements, theta: Floats
) -> ReducedSystem:
    """Return the system without the force that makes a solution too small, because this force would move the parameters.

    The more the size of the map depends on a parameter, the more the force acts on the parameter. If all lengths have an
    unknown scale, everything can grow in proportion at no cost, and nothing but the force determines the common scale. So
    the common scale is projected out (the gauge of a free network; Meissl 1969). If some length is known, the force is
    computed and removed from the gradient. theta: (P,) the shared errors.
    """
    landmarks = state.positions[state.landmarks]
    if not len(landmarks):
        return system
    away = np.linalg.norm(landmarks - np.median(landmarks, axis=0), axis=1)
    near = away <= _FAR * np.median(away)  # A far landmark is poorly determined, and does not grow with the map.
    around = landmarks[near] - landmarks[near].mean(axis=0)  # Without the mean, a shift of the map would count as growth.
    moved = system.sensitivity[: landmarks.size].reshape(*landmarks.shape, system.sensitivity.shape[1])[near]
    size = np.einsum("ni,nip->p", around, moved) / max(float((around**2).sum()), 1e-12)
    growing = np.where([name in errors.unknown_scales for name in errors.names], 1 + theta, 0.0)
    if not growing @ size > _LEAST_GROWTH:
        force = shrinking_force(state)[0] + force_of_heights(state)
        return replace(system, gradient=system.gradient + force * size)
    project = np.eye(len(theta)) - np.outer(size, growing) / (growing @ size)
    return replace(
        system,
        gradient=project @ system.gradient,
        slope=project @ system.slope @ project.T,
        variance=project @ system.variance @ project.T,
    )
