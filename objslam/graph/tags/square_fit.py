"""Fit the poses of squares to the directions of their corners, at fixed camera poses: many squares at once."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import make_pose
from objslam.core.rotation import rotation_from_vector, skew
from objslam.core.statistics import CAUCHY_K
from objslam.graph.factors.bearing import tangent_basis

_BEHIND = 1e-3
"""The least depth of a corner along its ray, as a share of its distance from the camera. A corner with a smaller share
counts as behind the camera: it costs `_BEHIND_COST` and has no gradient. A larger share counts more corners as behind."""
_BEHIND_COST = 1e6
"""The squared deviation of a corner behind its camera. A larger value excludes such poses more surely."""
_DAMPING = 1e-3
"""The first damping of Levenberg-Marquardt, as a share of the diagonal. A larger share takes smaller first steps."""

_MOST_LEVERAGE = 0.9
"""The share of the leverage for which the residuals of a view are corrected. A view draws the fit towards itself, so its
residuals are too small. The leverage is the influence of the view on the fit. The share is below 1, because a view that
decides alone has residuals of 0, which cannot be corrected. A larger share widens the covariances of squares that few views
show."""


@dataclass(frozen=True)
class Corners:
    """The corners that V views of squares show. Each view belongs to one square.

    square: (V,) index of the square. origin: (V, 3) m in map, where the rays begin. direction: (V, 4, 3) unit, in map.
    sigma: (V,) rad, the noise of one corner. whitening: (V, 8, 8) the matrix that multiplies the eight residuals of a view
    after their division by sigma. The matrix is the identity if the corners err independently (see `with_pose_noise`).
    """

    square: Ints
    origin: Floats
    direction: Floats
    sigma: Floats
    whitening: Floats

    def __len__(self) -> int:
        return len(self.square)

    def take(self, views: Bools | Ints) -> Self:
        """Select views by a mask or indices."""
        return replace(self, **{name: value[views] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Squares:
    """H squares in map. shape: (H, 4, 3) the corners at side 1. pose: (H, 4, 4) map_T_square. side: (H,) m."""

    shape: Floats
    pose: Floats
    side: Floats

    @property
    def corners(self) -> Floats:
        """(H, 4, 3) m in map."""
        local = self.shape * self.side[:, None, None]
        return np.asarray(np.einsum("hij,hcj->hci", self.pose[:, :3, :3], local) + self.pose[:, None, :3, 3])

    def take(self, which: Bools | Ints) -> Self:
        """Select squares by a mask or indices."""
        return replace(self, shape=self.shape[which], pose=self.pose[which], side=self.side[which])


def costs(seen: Corners, squares: Squares) -> Floats:
    """Return the cost (H,) of each square, which is the sum of Cauchy's loss over the deviations of its corners."""
    residual, _, ahead = _residuals(seen, squares.corners)
    residual = (seen.whitening @ residual.reshape(len(seen), 8, 1)).reshape(-1, 4, 2)
    return _cost(residual, ahead, seen, len(squares.side))


def fit(seen: Corners, squares: Squares, free: Bools, iterations: int) -> tuple[Squares, Floats, Floats]:
    """Return the squares that fit the corners best, near the given ones, by Levenberg-Marquardt with Cauchy's loss.

    free: (H,) whether the side is also fitted. Returns the squares, their costs (H,), and the information (H, 7, 7) about
    each. The information is about rotation and position in the frame of the square, then about the logarithm of the side.
    For a fixed side, the last row and column are those of an identity matrix.
    """
    count = len(squares.side)
    damping = np.full(count, _DAMPING)
    cost, information, gradient = _linearised(seen, squares, free)
    for _ in range(iterations):
        diagonal = np.einsum("hii->hi", information)
        damped = information.copy()
        np.einsum("hii->hi", damped)[...] += damping[:, None] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-9
        step = np.asarray(-np.linalg.solve(damped, gradient[..., None])[..., 0], dtype=np.float64)
        other = _moved(squares, step)
        tried, other_information, other_gradient = _linearised(seen, other, free)
        better = tried < cost
        squares = Squares(
            squares.shape,
            np.where(better[:, None, None], other.pose, squares.pose),
            np.where(better, other.side, squares.side),
        )
        information = np.where(better[:, None, None], other_information, information)
        gradient = np.where(better[:, None], other_gradient, gradient)
        cost, damping = np.where(better, tried, cost), np.where(better, damping / 5, damping * 8)
    return squares, cost, information


def _moved(squares: Squares, step: Floats) -> Squares:
    turned = squares.pose[:, :3, :3] @ rotation_from_vector(step[:, :3])
    place = squares.pose[:, :3, 3] + np.einsum("hij,hj->hi", squares.pose[:, :3, :3], step[:, 3:6])
    return Squares(squares.shape, make_pose(turned, place), squares.side * np.exp(np.clip(step[:, 6], -1.0, 1.0)))


def _residuals(seen: Corners, corners: Floats) -> tuple[Floats, Floats, Bools]:
    """Return residuals (V, 4, 2) in units of `sigma`, their derivatives (V, 4, 2, 3) by the corners in map, and which
    corners (V, 4) are ahead. The axes of the residuals have nearly the same directions at all four corners of a view."""
    to = corners[seen.square] - seen.origin[:, None]
    along = np.einsum("vci,vci->vc", seen.direction, to)
    ahead = along > _BEHIND * np.linalg.norm(to, axis=2)
    safe = np.where(ahead, along, 1.0)
    first = tangent_basis(_middle(seen))[:, None, :, 0]
    first = first - np.einsum("vci,vji->vcj", seen.direction, first) * seen.direction
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    basis = np.stack([first, np.cross(seen.direction, first)], axis=3)
    plane = np.einsum("vcij,vci->vcj", basis, to) / safe[..., None]
    by_point = np.swapaxes(basis, 2, 3) - plane[..., None] * seen.direction[:, :, None, :]
    by_point /= (safe * seen.sigma[:, None])[..., None, None]
    return plane / seen.sigma[:, None, None], by_point, np.asarray(ahead)


def _middle(seen: Corners) -> Floats:
    """Return the unit directions (V, 3) to the middle of each view."""
    middle = seen.direction.mean(axis=1)
    return np.asarray(middle / np.linalg.norm(middle, axis=1, keepdims=True))


def with_pose_noise(seen: Corners, squares: Squares, angle: Floats, place: Floats) -> Corners:
    """Return views whose cameras have noise. angle: (V,) rad, the standard deviation of the camera's rotation about each
    axis. place: (V,) m, the standard deviation of its position along each axis.

    The noise of a camera moves the four corners of its view together. So the residuals have the covariance sigma^2 I +
    J S J^T. S is the covariance of this noise. J is the derivative of the residuals by the pose of the camera, at the given
    squares (H). So all poses that are compared later have the same J.
    """
    _, by_point, _ = _residuals(seen, squares.corners)
    by_place = by_point.reshape(len(seen), 8, 3) * place[:, None, None]
    # A turn of the camera moves its whole image. The turn of the image about the line of sight is neglected.
    by_turn = np.tile(np.eye(2), (4, 1)) * (angle / seen.sigma)[:, None, None]
    shared = np.concatenate([by_place, by_turn], axis=2)
    root = np.linalg.cholesky(np.eye(8) + shared @ np.swapaxes(shared, 1, 2))
    return replace(seen, whitening=np.linalg.inv(root))


def independent(count: int) -> Floats:
    """Return the whitening (V, 8, 8) of V views whose corners err independently."""
    return np.tile(np.eye(8), (count, 1, 1))


def _cost(residual: Floats, ahead: Bools, seen: Corners, count: int) -> Floats:
    squared = (residual**2).sum(axis=2)
    each = np.where(ahead, CAUCHY_K**2 * np.log1p(squared / CAUCHY_K**2), _BEHIND_COST)
    return np.asarray(np.bincount(seen.square, each.sum(axis=1), count), dtype=np.float64)


def scatter(seen: Corners, squares: Squares, free: Bools, covariance: Floats) -> Floats:
    """Return the sums (H, 7, 7) of the squared gradients of each square's views. The corners of a view may share errors.

    covariance: (H, 7, 7) the inverse C of the information. The covariance of a fit is C S C, where S is the returned sum
    (cluster-robust; Liang and Zeger 1986). The residuals of a fit are smaller than the errors, most of all in the views that
    decide it. So the residuals of each view are from a fit without this view (Mancl and DeRouen 2001).
    """
    flat, weighted, residual, _ = _jacobians(seen, squares, free)
    leverage = flat @ covariance[seen.square] @ np.swapaxes(weighted, 1, 2)
    own = np.eye(8) - _MOST_LEVERAGE * leverage
    without = np.linalg.solve(own, residual.reshape(len(seen), 8, 1))[..., 0]
    gradient = np.einsum("vak,va->vk", weighted, without)
    result = np.zeros((len(squares.side), 7, 7))
    np.add.at(result, seen.square, gradient[:, :, None] * gradient[:, None, :])
    return result


def _linearised(seen: Corners, squares: Squares, free: Bools) -> tuple[Floats, Floats, Floats]:
    """Return the costs (H,), the information (H, 7, 7), and half the gradients (H, 7), with the weights of Cauchy's loss."""
    count = len(squares.side)
    flat, weighted, residual, ahead = _jacobians(seen, squares, free)
    information, gradient = np.zeros((count, 7, 7)), np.zeros((count, 7))
    np.add.at(information, seen.square, np.swapaxes(weighted, 1, 2) @ flat)
    np.add.at(gradient, seen.square, np.einsum("vak,va->vk", weighted, residual.reshape(len(seen), 8)))
    information[:, 6, 6] += ~free
    return _cost(residual, ahead, seen, count), information, gradient


def _jacobians(seen: Corners, squares: Squares, free: Bools) -> tuple[Floats, Floats, Floats, Bools]:
    """Return the Jacobians of the residuals of V views of squares.

    The four arrays are the derivatives (V, 8, 7) by the parameters of the squares, the same derivatives times the weights of
    Cauchy's loss, the residuals (V, 4, 2), and a mask (V, 4) of the corners that are ahead of the camera.
    """
    count, rotation = len(squares.side), squares.pose[:, :3, :3]
    residual, by_point, ahead = _residuals(seen, squares.corners)
    local = squares.shape * squares.side[:, None, None]
    by_square = np.concatenate(
        [-skew(local), np.broadcast_to(np.eye(3), (count, 4, 3, 3)), (local * free[:, None, None])[..., None]], axis=3
    )
    turned = np.einsum("hij,hcjk->hcik", rotation, by_square)
    jacobian = np.einsum("vcai,vcik->vcak", by_point, turned[seen.square]).reshape(len(seen), 8, 7)
    jacobian = (seen.whitening @ jacobian).reshape(-1, 4, 2, 7)
    residual = (seen.whitening @ residual.reshape(len(seen), 8, 1)).reshape(-1, 4, 2)
    weight = np.where(ahead, 1 / (1 + (residual**2).sum(axis=2) / CAUCHY_K**2), 0.0)[..., None]
    weighted = jacobian * weight[..., None]
    return jacobian.reshape(len(seen), 8, 7), weighted.reshape(len(seen), 8, 7), residual, ahead


def poses_of_views(seen: Corners, shapes: Floats, iterations: int) -> Squares:
    """Return the two poses of each view of a square of side 1: 2 V squares, the first pose of every view, then the second.

    A flat square that is far off, or seen from the front, looks nearly alike in two poses (Schweighofer and Pinz 2006). The
    first pose is from the homography between the square and its image. The second pose has the normal on the other side of
    the line of sight. Both are then fitted to the corners of their view. shapes: (V, 4, 3).
    """
    middle = _middle(seen)
    axes = np.concatenate([tangent_basis(middle), middle[:, :, None]], axis=2)
    local = np.einsum("vij,vci->vcj", axes, seen.direction)
    image = local[..., :2] / local[..., 2:]
    x, y = shapes[..., 0], shapes[..., 1]
    rows = np.zeros((len(seen), 4, 2, 8))
    rows[:, :, 0, 0], rows[:, :, 0, 1], rows[:, :, 0, 2] = x, y, 1
    rows[:, :, 1, 3], rows[:, :, 1, 4], rows[:, :, 1, 5] = x, y, 1
    rows[..., 6], rows[..., 7] = -image * x[..., None], -image * y[..., None]
    found = np.linalg.solve(rows.reshape(-1, 8, 8), image.reshape(-1, 8, 1))[..., 0]
    matrix = np.concatenate([found, np.ones((len(seen), 1))], axis=1).reshape(-1, 3, 3)
    size = np.linalg.norm(matrix[:, :, :2], axis=1).mean(axis=1)
    u, _, vt = np.linalg.svd(matrix[:, :, :2], full_matrices=False)
    two = u @ vt
    rotation = np.concatenate([two, np.cross(two[:, :, 0], two[:, :, 1])[:, :, None]], axis=2)
    pose = make_pose(axes @ rotation, np.einsum("vij,vj->vi", axes, matrix[:, :, 2] / size[:, None]) + seen.origin)
    one = Squares(shapes, pose, np.ones(len(seen)))
    both = stacked(one, mirrored(one, seen.origin))
    views = replace(seen, square=np.arange(len(seen)))
    twice = Corners(
        np.concatenate([views.square, views.square + len(seen)]),
        *(np.concatenate([part, part]) for part in (seen.origin, seen.direction, seen.sigma, seen.whitening)),
    )
    return fit(twice, both, np.zeros(len(both.side), dtype=bool), iterations)[0]


def mirrored(squares: Squares, origins: Floats) -> Squares:
    """Return the squares with their normals on the other side of the lines of sight from points (H, 3) m in map."""
    sight = squares.pose[:, :3, 3] - origins
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    half_turn = 2 * sight[:, :, None] * sight[:, None, :] - np.eye(3)
    turned = half_turn @ squares.pose[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    return replace(squares, pose=make_pose(turned, squares.pose[:, :3, 3]))


def stacked(*parts: Squares) -> Squares:
    """Return the squares of all parts, one part after the other."""
    return Squares(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("shape", "pose", "side")))
