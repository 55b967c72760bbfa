"""Two maps to be registered, and the robust fit of transforms to the objects that match."""

import numpy as np
from scipy.spatial import KDTree

from objslam.association.place_recognition import Constellation
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import HUBER_K, SAME_POINT

_FLOOR = 0.01
"""The standard deviation (m) added to each position, so that exact maps can be registered. A larger value matches more."""
_DENSITY_NEIGHBOURS = 8
"""The number of nearest objects from which the local density of objects is computed. A larger number smooths it more."""


class Problem:
    """Maps a and b, each relative to its centre, with values that are computed only once.

    spread_a, spread_b: (N,) and (M,) m^2, the horizontal variance of each position. apart: m, more than any distance of two
    objects.
    """

    def __init__(self, a: Constellation, b: Constellation) -> None:
        self.a, self.b = a, b
        self.spread_a, self.spread_b = (np.trace(m.covariance[:, :2, :2], axis1=1, axis2=2) / 2 for m in (a, b))
        self.apart = 4 * max(float(np.abs(m.position).max()) for m in (a, b)) + 1.0
        self._labelled = KDTree(np.column_stack([b.position, b.label * self.apart]))
        self._level = KDTree(b.position[:, :2])
        order = np.lexsort((b.position[:, 2], b.label))
        self._heights = b.position[order, 2] + b.label[order] * 4 * self.apart

    def nearest(self, moved: Floats, index: Ints) -> Ints:
        """Return for each object of map a the index (H, P) of the nearest object of map b with the same label.

        index: (H, P) the objects of a. moved: (H, P, 3) m, their positions in the frame of b.
        """
        at = np.concatenate([moved, self.a.label[index][..., None] * self.apart], axis=-1)
        return np.asarray(self._labelled.query(at.reshape(-1, 4))[1]).reshape(index.shape)

    def chance(self, moved: Floats, index: Ints, covariance: Floats) -> Floats:
        """Return the probability (H, P) that an object of a, moved to (H, P, 3), has a match in b by chance."""
        k = min(_DENSITY_NEIGHBOURS, len(self.b.label))
        radius = np.asarray(self._level.query(moved[..., :2].reshape(-1, 2), k=[k])[0]).reshape(index.shape)
        area = np.pi * SAME_POINT * np.sqrt(np.linalg.det(covariance[..., :2, :2]))
        reach = np.minimum(np.sqrt(SAME_POINT * covariance[..., 2, 2]), self.apart)
        height = np.clip(moved[..., 2], -self.apart, self.apart) + self.a.label[index] * 4 * self.apart
        like = np.searchsorted(self._heights, height + reach) - np.searchsorted(self._heights, height - reach)
        mean = k / (np.pi * radius**2 + area) * area * np.maximum(like, 1) / len(self.b.label)
        return -np.expm1(-mean)


def centred(whole: Constellation, keep: Ints, centre: Floats) -> Constellation:
    """Return the objects `keep` (N,) of a map, relative to a centre (3,) m, with `_FLOOR` added to their covariances."""
    return Constellation(whole.position[keep] - centre, whole.covariance[keep] + _FLOOR**2 * np.eye(3), whole.label[keep])


def move(x: Floats, points: Floats) -> Floats:
    """Return points (..., P, 3) under transforms (..., 4), each of x, y, z (m) and yaw (rad)."""
    cos, sin = np.cos(x[..., 3, None]), np.sin(x[..., 3, None])
    turned = (cos * points[..., 0] - sin * points[..., 1], sin * points[..., 0] + cos * points[..., 1])
    return np.stack([*turned, np.broadcast_to(points[..., 2], turned[0].shape)], axis=-1) + x[..., None, :3]


def covariances(problem: Problem, x: Floats, a: Ints, b: Ints) -> Floats:
    """Return the covariances (H, P, 3, 3), m^2, of the offsets between moved objects and others.

    a: (H, P) the objects that x (H, 4) moves. b: (H, P) the others.
    """
    rotation = lift_se2(np.stack([x[:, 0], x[:, 1], x[:, 3]], axis=1))[:, None, :3, :3]
    return rotation @ problem.a.covariance[a] @ np.swapaxes(rotation, -1, -2) + problem.b.covariance[b]


def jacobian_of(x: Floats, moved: Floats) -> Floats:
    """Return the Jacobians (H, P, 3, 4) of points `moved` (H, P, 3) by x, y, z and yaw of the transforms x (H, 4)."""
    jacobian = np.zeros((*moved.shape, 4))
    jacobian[..., [0, 1, 2], [0, 1, 2]] = 1.0
    jacobian[..., 0, 3] = -(moved[..., 1] - x[:, None, 1])
    jacobian[..., 1, 3] = moved[..., 0] - x[:, None, 0]
    return jacobian


def gate(problem: Problem, index: Ints, x: Floats, hessian: Floats) -> tuple[Ints, Floats, Floats, Floats, Bools]:
    """Match objects `index` (H, P) of map a to the nearest objects of map b, under transforms x (H, 4).

    Return these partners (H, P), the offsets, covariances and Jacobians, and which match. hessian: (H, 4, 4) the information
    of the transforms, NaN before the first fit. Its inverse widens the gates.
    """
    moved = move(x, problem.a.position[index])
    partner = problem.nearest(moved, index)
    miss = problem.b.position[partner] - moved
    covariance = covariances(problem, x, index, partner)
    jacobian = jacobian_of(x, moved)
    known = np.isfinite(hessian).all(axis=(1, 2))
    doubt = np.zeros((len(x), 4, 4))
    doubt[known] = np.linalg.inv(hessian[known])
    total = covariance + jacobian @ doubt[:, None] @ np.swapaxes(jacobian, -1, -2)
    squared = (miss * np.linalg.solve(total, miss[..., None])[..., 0]).sum(axis=-1)
    limit = np.where(known, SAME_POINT, 2 * SAME_POINT)[:, None]  # Before the first fit, the heading is not precise.
    return partner, miss, covariance, jacobian, squared <= limit


def fit(problem: Problem, index: Ints, x: Floats, hessian: Floats) -> tuple[Floats, Floats]:
    """Return transforms (H, 4) after one robust Gauss-Newton step on the matches of objects (H, P), and their information.

    A transform that its matches do not determine stays, and its information is NaN. One match is never enough.
    """
    _, miss, covariance, jacobian, good = gate(problem, index, x, hessian)
    return robust_step(x, miss, covariance, jacobian, good)


def robust_step(x: Floats, miss: Floats, covariance: Floats, jacobian: Floats, good: Bools) -> tuple[Floats, Floats]:
    """Return transforms (H, 4) after one Gauss-Newton step with Huber's weights, and their information (H, 4, 4).

    miss, covariance, jacobian: (H, P, 3), (H, P, 3, 3) and (H, P, 3, 4) of the pairs. good: (H, P) which pairs match.
    """
    information = np.linalg.inv(covariance)
    deviation = np.sqrt(np.einsum("hpi,hpij,hpj->hp", miss, information, miss))
    weight = good * np.minimum(1.0, HUBER_K / np.maximum(deviation, 1e-12))
    weighted = np.swapaxes(jacobian, -1, -2) @ (information * weight[..., None, None])
    hessian = (weighted @ jacobian).sum(axis=1)
    gradient = (weighted @ miss[..., None])[..., 0].sum(axis=1)
    fixed = (good.sum(axis=1) >= 2) & (np.linalg.cond(hessian) < 1e12)
    hessian[~fixed] = np.eye(4)
    step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
    hessian[~fixed] = np.nan
    return np.where(fixed[:, None], x + step, x), hessian


def one_each(partner: Ints, good: Bools) -> Bools:
    """Return which matches (H, P) remain if an object of b may be matched only once in each row."""
    marked = np.where(good, partner, -1 - np.arange(partner.shape[1]))
    order = np.argsort(marked, axis=1, kind="stable")
    ordered = np.take_along_axis(marked, order, axis=1)
    first = np.ones(good.shape, dtype=bool)
    first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
    once = np.zeros(good.shape, dtype=bool)
    np.put_along_axis(once, order, first, axis=1)
    return once & good
