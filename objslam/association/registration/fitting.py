"""Two maps to be registered, and the robust fit of transforms to the objects that match."""

import numpy as np
from scipy.spatial import KDTree

from objslam.association.registration.shapes import Shape
from objslam.core.arrays import Array, Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.maps.shared_covariance import jacobian as shared_jacobian
from objslam.core.statistics import HUBER_K, SAME_POINT

_DETERMINED = 1e12
"""The largest condition number of the information of a transform that its matches determine. A larger number accepts less
certain transforms."""
_DENSITY_NEIGHBOURS = 8
"""The number of nearest objects from which the local density of objects is computed. A larger number smooths the density
more."""
_ALIKE_NEIGHBOURS = 4
"""The number of nearest objects from which the local density of objects of one label is computed. A smaller number finds the
density of smaller groups of equal objects, so matches in groups give less evidence. With 4, false alarms in simulated places
of groups of two, three and five are as rare as the log odds say."""


class Problem:
    """Maps a and b, each relative to its centre, with values that are computed only once.

    spread_a, spread_b: (N,) and (M,) m^2, the horizontal variance of each object's own error. apart: m, more than any
    distance of two objects.
    """

    def __init__(self, a: Shape, b: Shape) -> None:
        self.a, self.b = a, b
        self.spread_a, self.spread_b = (np.trace(m.own[:, :2, :2], axis1=1, axis2=2) / 2 for m in (a, b))
        self.apart = 4 * max(float(np.abs(m.position).max()) for m in (a, b)) + 1.0
        self._labelled = KDTree(np.column_stack([b.position, b.label * self.apart]))
        self._level = KDTree(b.position[:, :2])
        self._alike = KDTree(np.column_stack([b.position[:, :2], b.label * self.apart]))
        self._count = np.bincount(b.label)
        order = np.lexsort((b.position[:, 2], b.label))
        self._heights = b.position[order, 2] + b.label[order] * 4 * self.apart

    def nearest(self, moved: Floats, index: Ints) -> Ints:
        """Return for each object of map a the index (H, P) of the nearest object of map b with the same label.

        index: (H, P) the objects of a. moved: (H, P, 3) m, their positions in the frame of b.
        """
        at = np.concatenate([moved, self.a.label[index][..., None] * self.apart], axis=-1)
        return np.asarray(self._labelled.query(at.reshape(-1, 4))[1]).reshape(index.shape)

    def chance(self, moved: Floats, index: Ints, covariance: Floats, limits: tuple[float, ...]) -> Floats:
        """Return the probability (L, H, P) that an object of a, moved to (H, P, 3), has a match in b by chance.

        H hypotheses each move P objects. limits: L limits of the squared Mahalanobis distance of a match. The local density
        of objects with the label is the larger one of two: the density of all objects times the share of the label, and the
        density of this label alone. Equal objects often stand in groups, such as chairs at a table. If one of them has a
        match by chance, others of its group also have one.
        """
        label = self.a.label[index]
        everything, alike = moved[..., :2], np.concatenate([moved[..., :2], label[..., None] * self.apart], axis=-1)
        area = np.pi * np.sqrt(np.linalg.det(covariance[..., :2, :2]))
        height = np.clip(moved[..., 2], -self.apart, self.apart) + label * 4 * self.apart
        found = []
        nearest, nearest_alike = (min(k, len(self.b.label)) for k in (_DENSITY_NEIGHBOURS, _ALIKE_NEIGHBOURS))
        others = max(nearest - 2, 1)  # The mean is right if the match and the farthest object do not count.
        counted = (
            (others / len(self.b.label), _farthest(self._level, everything, nearest)),
            (nearest_alike / self._count[label], _farthest(self._alike, alike, nearest_alike)),
        )
        for limit in limits:
            reach = np.minimum(np.sqrt(limit * covariance[..., 2, 2]), self.apart)
            like = np.searchsorted(self._heights, height + reach) - np.searchsorted(self._heights, height - reach)
            density = np.maximum(*(share / (np.pi * radius**2 + limit * area) for share, radius in counted))
            found.append(-np.expm1(-density * limit * area * np.maximum(like, 1)))
        return np.array(found)


def _farthest(tree: KDTree, points: Floats, number: int) -> Floats:
    """Return the distance (H, P), m, from each point (H, P, d) to the `number`-th nearest object."""
    distance = np.asarray(tree.query(points.reshape(-1, points.shape[-1]), k=[number])[0])
    return distance.reshape(points.shape[:-1])


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

    Return these partners (H, P), the offsets, covariances and Jacobians, and which pairs match (H, P). hessian: (H, 4, 4)
    the information of the transforms, NaN before the first fit. Its inverse widens the gates.
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

    A transform that its matches do not determine does not change, and its information is NaN. One match is never enough.
    """
    _, miss, covariance, jacobian, good = gate(problem, index, x, hessian)
    return robust_step(x, miss, covariance, jacobian, good)


def robust_step(x: Floats, miss: Floats, covariance: Floats, jacobian: Floats, good: Bools) -> tuple[Floats, Floats]:
    """Return transforms (H, 4) after one Gauss-Newton step with Huber's weights, and their information (H, 4, 4).

    miss, covariance, jacobian: (H, P, 3), (H, P, 3, 3) and (H, P, 3, 4) of the pairs. good: (H, P) which pairs match.
    """
    information = np.linalg.inv(covariance)
    weighted = np.swapaxes(jacobian, -1, -2) @ (information * (good * _weights(miss, information))[..., None, None])
    hessian = (weighted @ jacobian).sum(axis=1)
    gradient = (weighted @ miss[..., None])[..., 0].sum(axis=1)
    fixed = (good.sum(axis=1) >= 2) & (np.linalg.cond(hessian) < _DETERMINED)
    hessian[~fixed] = np.eye(4)
    step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
    hessian[~fixed] = np.nan
    return np.where(fixed[:, None], x + step, x), hessian


def _weights(miss: Floats, information: Array) -> Floats:
    """Return Huber's weights (..., P) of offsets (..., P, 3) m with information (..., P, 3, 3)."""
    deviation = np.sqrt(np.einsum("...pi,...pij,...pj->...p", miss, information, miss))
    return np.asarray(np.minimum(1.0, HUBER_K / np.maximum(deviation, 1e-12)))


def transform_covariance(problem: Problem, x: Floats, a: Ints, b: Ints) -> Floats:
    """Return the covariance (4, 4) of a transform x (4,) that was fitted to the pairs of objects a (P,) and b (P,).

    The shared errors of both maps move the fit. The module `shapes` derives how far. So the covariance contains the shared
    shift and yaw in full, however many pairs there are. It also contains the effect of the shared tilt and size on this fit.
    It is NaN if the pairs do not determine the transform.
    """
    moved = move(x[None], problem.a.position[a][None])
    offset = covariances(problem, x[None], a[None], b[None])[0]
    information = np.linalg.inv(offset)
    weight = _weights(problem.b.position[b] - moved[0], information)[:, None, None]
    lever = jacobian_of(x[None], moved)[0]
    pull = np.swapaxes(lever, 1, 2) @ (information * weight)
    hessian = (pull @ lever).sum(axis=0)
    if np.linalg.cond(hessian) > _DETERMINED:
        return np.full((4, 4), np.nan)
    gain = np.linalg.inv(hessian) @ pull
    rotation = lift_se2(x[[0, 1, 3]])[:3, :3]
    own = (rotation @ problem.a.own[a] @ rotation.T + problem.b.own[b]) / weight
    total = (gain @ own @ np.swapaxes(gain, 1, 2)).sum(axis=0)
    for shape, turn, at in ((problem.a, rotation, problem.a.position[a]), (problem.b, np.eye(3), moved[0])):
        moves = (gain @ turn @ shared_jacobian(at)).sum(axis=0)
        total += moves @ shape.shared @ moves.T
    return np.asarray((total + total.T) / 2)


def one_each(partner: Ints, good: Bools) -> Bools:
    """Return which matches (H, P) remain if each transform (row) may match an object of b only once."""
    marked = np.where(good, partner, -1 - np.arange(partner.shape[1]))
    order = np.argsort(marked, axis=1, kind="stable")
    ordered = np.take_along_axis(marked, order, axis=1)
    first = np.ones(good.shape, dtype=bool)
    first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
    once = np.zeros(good.shape, dtype=bool)
    np.put_along_axis(once, order, first, axis=1)
    return once & good
