"""Whitening, robust weights and derivatives that all rows of a joint graph share."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.statistics import HUBER_K


def whitening(covariance: Floats) -> Floats:
    """Return upper triangular matrices (n, 6, 6) that whiten residuals with covariances (n, 6, 6), as GTSAM does.

    The matrices are inverse roots of the covariances. The inverse of a whole covariance would lose twice the digits. If the
    largest variance is 1e11 times the smallest, this inverse may not be positive definite.
    """
    # The roots are upper triangular, because the axes are in reverse order. The loops fill one entry of all inverses at
    # once, because numpy takes 1 us for the inverse of one small matrix.
    root = np.moveaxis(np.linalg.cholesky(covariance[:, ::-1, ::-1]), 0, 2).copy()
    inverse, product = np.zeros_like(root), np.empty(len(covariance))
    for j in range(len(root)):
        inverse[j, j] = 1 / root[j, j]
        for i in range(j + 1, len(root)):
            for k in range(j, i):
                inverse[i, j] -= np.multiply(root[i, k], inverse[k, j], out=product)
            inverse[i, j] /= root[i, i]
    return np.ascontiguousarray(np.moveaxis(inverse, 2, 0)[:, ::-1, ::-1])


def huber_roots(size: Floats) -> tuple[Floats, Floats]:
    """Return the square roots (n,) of Huber's weights for whitened norms (n,), and the costs (n,)."""
    weight = np.sqrt(np.minimum(1.0, HUBER_K / np.maximum(size, 1e-12)))
    return weight, np.where(size <= HUBER_K, size**2 / 2, HUBER_K * (size - HUBER_K / 2))


def by_end(twist: Floats) -> Floats:
    """Return the derivatives (n, 6, 6) of log(X exp(d)) by d at 0, for the twists (n, 6) log(X).

    This is the inverse of the right Jacobian of SE(3) up to the square of the twist (Barfoot, State Estimation for Robotics,
    eq. 8.102). The error is the twist's fourth power divided by 720.
    """
    turn, move = twist[:, :3], twist[:, 3:]
    # With the cross-product matrices W and V of both halves, W W = w w^T - (w . w) I, and V W + W V = v w^T + w v^T -
    # 2 (w . v) I.
    part = turn / 12
    same, below = part[:, :, None] * turn[:, None, :], part[:, :, None] * move[:, None, :]
    below = below + np.swapaxes(below, 1, 2)
    diagonal = 1 - np.einsum("ni,ni->n", part, turn), -2 * np.einsum("ni,ni->n", part, move)
    for block, more, half in ((same, diagonal[0], turn / 2), (below, diagonal[1], move / 2)):
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            block[:, i, i] += more
            block[:, k, j] += half[:, i]
            block[:, j, k] -= half[:, i]
    result = np.zeros((len(twist), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = same
    result[:, 3:, :3] = below
    return result
