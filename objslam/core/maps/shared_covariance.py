"""The error that all objects of a map share: the map as a whole is shifted, turned, and too large or too small.

The path drifts between the start and the objects, and the size of the map may be uncertain. Both move all objects together.
So the error of an object at p is e_shift + e_turn x p + e_size p, plus an error of its own. The seven numbers of the shared
error are a shift (m), a rotation vector (rad) and the logarithm of a size, at the origin of the frame. Their covariance is
one matrix for the whole map. The covariance of each object contains what the shared error adds to it.
"""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.rotation import skew

NUMBERS = 7
"""The numbers of a shared error: a shift (3), a rotation vector (3), and the logarithm of a size."""
SIZE = 6
"""The index of the size among the numbers of a shared error."""
_FEWEST = 3
"""The least number of objects with a shared error. Two objects do not determine a turn about their line."""
_FLOOR = 1e-3
"""The least standard deviation (m) of an object's own error. A larger value keeps linear systems better conditioned, and
counts a smaller part of the errors of exact maps as shared. This value is far below the errors of real maps."""
_INDEFINITE = 1e-10
"""The least eigenvalue of the information about the shared error, relative to the largest one, with lengths in units of the
map's extent. Directions below it have no shared error. A larger value leaves out more directions."""


def jacobian(points: Floats) -> Floats:
    """Return the derivatives (..., 3, 7) of points (..., 3) by the shared error."""
    points = np.asarray(points, dtype=np.float64)
    found = np.zeros((*points.shape, NUMBERS))
    found[..., :3] = np.eye(3)
    found[..., 3:6] = -skew(points)
    found[..., 6] = points
    return found


def shared_covariance(points: Floats, covariance: Floats, factor: Floats) -> Floats | None:
    """Return the covariance (7, 7) of the shared error of objects at points (N, 3), None for fewer than three objects.

    covariance: (N, 3, 3) m^2 of the objects. factor: (N, 3, m) m, the correlated part of their errors. The joint covariance
    is the factor times its own transpose, plus a block for each object. The seven numbers are estimated from the objects by
    the best linear estimate (Gauss and Markov): once with this joint covariance, once with the blocks alone. The result is
    the covariance of the first estimate minus the covariance of the second. It is exact if all correlated errors are shifts,
    turns and sizes. Other correlated errors, such as bends of the path, then count as errors of the objects. The covariance
    of each object is never smaller than what the shared error adds to it.
    """
    if len(points) < _FEWEST or not factor.shape[2]:
        return None
    centre = points.mean(axis=0)
    extent = float(max(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()), _FLOOR))
    scale = np.array([1.0] * 3 + [1 / extent] * 4)
    lever = jacobian(points - centre) * scale
    own = own_part(covariance, factor)
    told = np.swapaxes(np.linalg.solve(own, np.concatenate([lever, factor], axis=2)), 1, 2)
    both = np.einsum("nki,nil->kl", told, np.concatenate([lever, factor], axis=2))
    alone, across, between = both[:NUMBERS, :NUMBERS], both[:NUMBERS, NUMBERS:], both[NUMBERS:, NUMBERS:]
    information = alone - across @ np.linalg.solve(between + np.eye(len(between)), across.T)  # Woodbury
    root = root_of(_inverse(information) - _inverse(alone)) * scale[:, None]
    back = np.eye(4)
    back[:3, 3] = centre
    return moved(root @ root.T, back)


def _inverse(information: Floats) -> Floats:
    """Return the inverse of an information matrix, 0 in directions without information."""
    size, axes = np.linalg.eigh((information + information.T) / 2)
    good = size > _INDEFINITE * size[-1]
    return np.asarray((axes[:, good] / size[good]) @ axes[:, good].T)


def moved(shared: Floats, b_T_a: Floats) -> Floats:
    """Return the covariance (7, 7) of a shared error in frame b. shared: (7, 7) in frame a. b_T_a: (4, 4)."""
    rotation, shift = b_T_a[:3, :3], b_T_a[:3, 3]
    turn = np.zeros((NUMBERS, NUMBERS))
    turn[:3, :3], turn[3:6, 3:6], turn[6, 6] = rotation, rotation, 1.0
    turn[:3, 3:6], turn[:3, 6] = skew(shift) @ rotation, -shift
    return turn @ shared @ turn.T


def root_of(covariance: Floats) -> Floats:
    """Return a matrix (n, n) whose product with its own transpose is the covariance (n, n)."""
    size, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))


def own_part(covariance: Floats, factor: Floats) -> Floats:
    """Return the covariances (N, 3, 3), m^2, without the part that a factor (N, 3, m), m, describes. They are at least
    `_FLOOR`^2."""
    own = covariance - factor @ np.swapaxes(factor, 1, 2)
    size, axes = np.linalg.eigh((own + np.swapaxes(own, 1, 2)) / 2)
    return np.asarray((axes * np.maximum(size, _FLOOR**2)[:, None, :]) @ np.swapaxes(axes, 1, 2))
