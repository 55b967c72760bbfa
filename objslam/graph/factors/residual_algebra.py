"""Whitening, robust weights and derivatives that all rows of a joint graph share."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.rotation import skew
from objslam.core.statistics import HUBER_K


def whitening(covariance: Floats) -> Floats:
    """Return upper triangular matrices (n, 6, 6) that whiten residuals with covariances (n, 6, 6), as GTSAM does.

    They are inverse roots of the covariances. The inverse of a covariance itself loses twice the digits, and need not be
    positive definite if its largest variance is 1e11 times its smallest.
    """
    root = np.linalg.cholesky(covariance[:, ::-1, ::-1])[:, ::-1, ::-1]  # Upper, because the axes are in reverse order.
    return np.asarray(np.linalg.inv(root))


def huber_roots(size: Floats) -> tuple[Floats, Floats]:
    """Return the roots (n,) of Huber's weights of whitened norms (n,), and the costs (n,)."""
    weight = np.sqrt(np.minimum(1.0, HUBER_K / np.maximum(size, 1e-12)))
    return weight, np.where(size <= HUBER_K, size**2 / 2, HUBER_K * (size - HUBER_K / 2))


def by_end(twist: Floats) -> Floats:
    """Return the derivatives (n, 6, 6) of log(X exp(d)) by d at 0, for the twists (n, 6) log(X).

    This is the inverse of the right Jacobian of SE(3) up to the square of the twist (Barfoot, State Estimation for Robotics,
    eq. 8.102). The error is the twist's fourth power divided by 720.
    """
    small = np.zeros((len(twist), 6, 6))
    small[:, :3, :3] = small[:, 3:, 3:] = skew(twist[:, :3])
    small[:, 3:, :3] = skew(twist[:, 3:])
    return np.asarray(np.eye(6) + small / 2 + small @ small / 12)
