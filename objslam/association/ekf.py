"""An extended Kalman filter of a robot's pose and of landmarks, with all correlations (Smith, Self and Cheeseman 1990).

The odometry may move in three dimensions. Its drift is planar: a shift and a turn about the vertical axis of map.
"""

from dataclasses import dataclass, field, fields
from typing import Self

import numpy as np

from objslam.association.gating import tangent_basis
from objslam.association.refinement import BEHIND
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.types import Rays

POSE = 3
"""The number of state entries of the pose: its errors in yaw (rad), x and y (m), along the axes of map."""
_LEAST = 1e-12
"""The variance added to each state entry in each correction, to keep the covariance positive definite. With a larger
variance, the filter trusts older rays less."""
_LEAST_DISTANCE = 1e-3
"""The least distance (m) by which a residual is divided. With a larger value, landmarks right at the camera count less."""


@dataclass
class Filter:
    """The state of the filter. map_T_base: (4, 4) the pose of the base. shared: (S,) errors that all motions share.
    position: (N, 3) m of landmarks. covariance: (D, D) with D = 3 + S + 3 N. Its order is yaw, x and y, then the shared
    errors, then the positions."""

    map_T_base: Floats
    shared: Floats
    covariance: Floats
    position: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def start(cls, map_T_base: Floats, prior: Floats) -> Self:
        """Start at a known pose (4, 4) without landmarks. prior: (S,) standard deviations of the shared errors."""
        return cls(map_T_base.copy(), np.zeros(len(prior)), np.diag(np.concatenate([np.zeros(POSE), prior**2])))

    def __len__(self) -> int:
        return len(self.position)

    @property
    def head(self) -> int:
        """The number of entries of the state before the first landmark."""
        return POSE + len(self.shared)

    def columns(self, landmark: Ints) -> Ints:
        """Return the entries (P, 3) of landmarks (P,) in the state."""
        return self.head + 3 * landmark[:, None] + np.arange(3)


@dataclass(frozen=True)
class Sight:
    """R rays relative to the base. offset: (R, 3) m, the origins in the base frame. direction: (R, 3) unit, in the base
    frame. sigma: (R,) rad, the noise of the directions. range, range_sigma: (R,) m, the ranges and their noise, NaN if
    unknown."""

    offset: Floats
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats

    @classmethod
    def of(cls, rays: Rays, base_T_camera: Floats) -> Self:
        """Make the sight from rays of cameras at base_T_camera (K, 4, 4)."""
        return cls(*rays.in_map(base_T_camera), rays.sigma, rays.range, rays.range_sigma)


@dataclass(frozen=True)
class Expected:
    """P pairs of a ray and a landmark, with the difference between the measured and the expected ray.

    residual: (P, 3), two components across the ray (rad), and one for the range (m), which is 0 without a range. by_pose,
    by_landmark: (P, 3, 3) the Jacobians of the expected ray. variance: (P, 3) the variances of the measurements. Without a
    range, the last variance is 1 / (2 pi), so that this component multiplies the likelihood by 1. ranged: (P,) whether there
    is a range.
    """

    landmark: Ints
    residual: Floats
    by_pose: Floats
    by_landmark: Floats
    variance: Floats
    ranged: Bools

    @classmethod
    def of(cls, f: Filter, sight: Sight, ray: Ints, landmark: Ints) -> Self:
        """Compare rays (P,) with landmarks (P,)."""
        turn, centre = f.map_T_base[:3, :3], f.map_T_base[:3, 3]
        n = sight.direction[ray] @ turn.T
        to = f.position[landmark] - centre - sight.offset[ray] @ turn.T
        distance = np.maximum(np.linalg.norm(to, axis=1), _LEAST_DISTANCE)
        axes, toward = tangent_basis(n), to / distance[:, None]
        ranged = np.isfinite(sight.range[ray])
        by_landmark = np.concatenate([axes / distance[:, None, None], (toward * ranged[:, None])[:, None]], axis=1)
        across = -np.einsum("pij,pj->pi", axes, toward)
        across[np.einsum("pi,pi->p", to, n) <= 0] = BEHIND
        along = np.where(ranged, sight.range[ray] - distance, 0.0)
        angle, length = sight.sigma[ray] ** 2, np.where(ranged, sight.range_sigma[ray] ** 2, 1 / (2 * np.pi))
        by_pose = -by_landmark @ _carried(f.position[landmark] - centre)
        residual, variance = np.column_stack([across, along]), np.column_stack([angle, angle, length])
        return cls(landmark, residual, by_pose, by_landmark, variance, ranged)

    def take(self, pairs: Ints) -> Self:
        """Select pairs by their indices."""
        return type(self)(*(getattr(self, each.name)[pairs] for each in fields(self)))

    def jacobian(self, f: Filter) -> Floats:
        """Return the Jacobian (P, 3, D) of the expected rays by the whole state."""
        jacobian = np.zeros((len(self.landmark), 3, len(f.covariance)))
        jacobian[:, :, :POSE] = self.by_pose
        np.put_along_axis(jacobian, f.columns(self.landmark)[:, None].repeat(3, axis=1), self.by_landmark, axis=2)
        return jacobian


def predict(f: Filter, motion: Floats, by_shared: Floats, noise: Floats) -> None:
    """Move the base by a measured motion (4, 4), corrected by the estimated shared errors.

    by_shared: (3, S) the derivative of the motion's yaw, x and y by the shared errors. noise: (3, 3) the covariance of the
    motion's yaw, x and y. Both are in the base frame after the motion.
    """
    before = f.map_T_base[:2, 3]
    after = f.map_T_base @ motion
    yaw, x, y = by_shared @ f.shared
    f.map_T_base = after @ lift_se2(np.array([x, y, yaw]))
    way = f.map_T_base[:2, 3] - before
    turn = np.eye(POSE)
    turn[1:, 1:] = f.map_T_base[:2, :2]
    step = np.eye(f.head)
    step[1, 0], step[2, 0] = -way[1], way[0]
    step[:POSE, POSE:] = turn @ by_shared
    f.covariance[: f.head] = step @ f.covariance[: f.head]
    f.covariance[:, : f.head] = f.covariance[:, : f.head] @ step.T
    f.covariance[:POSE, :POSE] += turn @ noise @ turn.T


def individual_covariances(f: Filter, expected: Expected) -> Floats:
    """Return the covariance (P, 3, 3) of the residual of each pair."""
    columns, by_pose, by_landmark = f.columns(expected.landmark), expected.by_pose, expected.by_landmark
    own = f.covariance[columns[:, :, None], columns[:, None, :]]
    cross = by_pose @ f.covariance[:POSE][:, columns].swapaxes(0, 1) @ by_landmark.swapaxes(1, 2)
    total = by_landmark @ own @ by_landmark.swapaxes(1, 2) + by_pose @ f.covariance[:POSE, :POSE] @ by_pose.swapaxes(1, 2)
    return np.asarray(total + cross + cross.swapaxes(1, 2) + expected.variance[:, :, None] * np.eye(3))


def within_reach(f: Filter, sight: Sight, ray: Ints, gate: float) -> Bools:
    """Return which pairs (n, N) of a ray (n,) and a landmark may have a squared deviation within the gate.

    This quick test keeps all such pairs. It uses the trace of a landmark's covariance, because no variance exceeds it.
    """
    turn, centre = f.map_T_base[:3, :3], f.map_T_base[:3, 3]
    moved = _carried(f.position - centre)
    own = np.diagonal(f.covariance)[f.head :].reshape(-1, 3).sum(axis=1)
    mixed = np.einsum("nip,pni->n", moved, f.covariance[:POSE, f.head :].reshape(POSE, -1, 3))
    spread = np.maximum(own - 2 * mixed + ((moved @ f.covariance[:POSE, :POSE]) * moved).sum(axis=(1, 2)), 0.0)
    to = f.position - (centre + sight.offset[ray] @ turn.T)[:, None]
    distance = np.maximum(np.linalg.norm(to, axis=2), _LEAST_DISTANCE)
    ahead = np.einsum("ri,rni->rn", sight.direction[ray] @ turn.T, to) / distance
    across = np.where(ahead > 0, 1 - ahead**2, 2 * BEHIND**2)
    off = np.nan_to_num((sight.range[ray][:, None] - distance) ** 2)
    near = off <= gate * (spread + np.nan_to_num(sight.range_sigma[ray])[:, None] ** 2)
    return np.asarray(near & (across <= gate * (spread / distance**2 + sight.sigma[ray][:, None] ** 2)))


def joint_covariance(f: Filter, expected: Expected) -> Floats:
    """Return the covariance (P, 3, P, 3) of all residuals. Pairs of one ray count as independent: at most one of them is
    true."""
    jacobian = expected.jacobian(f).reshape(-1, len(f.covariance))
    total = jacobian @ f.covariance @ jacobian.T
    total[np.diag_indices(len(total))] += expected.variance.ravel()
    return np.asarray(total.reshape(*expected.residual.shape, *expected.residual.shape))


def update(f: Filter, expected: Expected) -> tuple[Floats, Floats]:
    """Correct the state by pairs of a ray and its landmark.

    Return the correction (3,) of yaw, x and y, and its expected covariance (3, 3).
    """
    known = np.column_stack([np.ones((len(expected.ranged), 2), dtype=bool), expected.ranged])
    return _correct(f, expected.jacobian(f)[known], expected.residual[known], expected.variance[known])


def differences(f: Filter, one: Ints, two: Ints) -> tuple[Floats, Floats]:
    """Return the offsets (P, 3) m from landmarks `one` (P,) to landmarks `two` (P,), and their covariances (P, 3, 3)."""
    block = f.covariance[f.head :, f.head :].reshape(len(f), 3, len(f), 3)
    mixed = block[one, :, two]
    return f.position[two] - f.position[one], block[one, :, one] + block[two, :, two] - mixed - mixed.swapaxes(1, 2)


def joint_differences(f: Filter, one: Ints, two: Ints, sigma: float) -> tuple[Floats, Floats]:
    """Return the offsets (P, 3) m of `differences`, and their joint covariance (P, 3, P, 3). sigma: m, the standard
    deviation of an additional error of each coordinate."""
    jacobian = _apart(f, one, two)
    total = jacobian @ f.covariance @ jacobian.T
    total[np.diag_indices(len(total))] += sigma**2
    return f.position[two] - f.position[one], np.asarray(total.reshape(len(one), 3, len(one), 3))


def tie(f: Filter, one: Ints, two: Ints, sigma: float) -> None:
    """Correct the state as if landmarks `one` (P,) and `two` (P,) were measured to coincide, with the noise `sigma` (m)."""
    _correct(f, _apart(f, one, two), (f.position[two] - f.position[one]).ravel(), np.full(3 * len(one), sigma**2))


def _apart(f: Filter, one: Ints, two: Ints) -> Floats:
    """Return the Jacobian (3P, D) of differences by the state: the positions of landmarks `one` minus the positions of
    landmarks `two`."""
    jacobian = np.zeros((len(one), 3, len(f.covariance)))
    for which, sign in ((one, 1.0), (two, -1.0)):
        jacobian[np.arange(len(one))[:, None], np.arange(3), f.columns(which)] = sign
    return jacobian.reshape(3 * len(one), -1)


def _carried(arm: Floats) -> Floats:
    """Return the derivatives (P, 3, 3) of points that move with the base, by its yaw, x and y.

    arm: (P, 3) m, the offsets of the points from the base, along the axes of the map.
    """
    moved = np.zeros((len(arm), 3, POSE))
    moved[:, 0, 0], moved[:, 1, 0], moved[:, 0, 1], moved[:, 1, 2] = -arm[:, 1], arm[:, 0], 1.0, 1.0
    return moved


def _correct(f: Filter, jacobian: Floats, innovation: Floats, variance: Floats) -> tuple[Floats, Floats]:
    cross = f.covariance @ jacobian.T
    total = jacobian @ cross
    total[np.diag_indices(len(total))] += variance
    gain = np.linalg.solve(total, cross.T).T
    step = gain @ innovation
    f.covariance = f.covariance - gain @ cross.T
    f.covariance = (f.covariance + f.covariance.T) / 2
    f.covariance[np.diag_indices(len(f.covariance))] += _LEAST
    turn = lift_se2(np.array([0.0, 0.0, step[0]]))[:3, :3]
    f.map_T_base = f.map_T_base.copy()
    f.map_T_base[:3, :3] = turn @ f.map_T_base[:3, :3]
    f.map_T_base[:2, 3] += step[1:POSE]
    f.shared = f.shared + step[POSE : f.head]
    f.position = f.position + step[f.head :].reshape(-1, 3)
    return step[:POSE], gain[:POSE] @ cross[:POSE].T


def ends(f: Filter, sight: Sight, ray: Ints) -> tuple[Floats, Floats]:
    """Return the ends (n, 3), m in map, of rays (n,) with ranges, and covariances (n, 3, 3) relative to the present pose."""
    turn, reach = f.map_T_base[:3, :3], sight.range[ray]
    n = sight.direction[ray] @ turn.T
    along = n[:, :, None] * n[:, None, :]
    across = ((reach * sight.sigma[ray]) ** 2)[:, None, None] * (np.eye(3) - along)
    position = f.map_T_base[:3, 3] + sight.offset[ray] @ turn.T + reach[:, None] * n
    return position, across + (sight.range_sigma[ray] ** 2)[:, None, None] * along


def add(f: Filter, position: Floats, covariance: Floats) -> None:
    """Add landmarks at positions (n, 3) with covariances (n, 3, 3) relative to the present pose of the base."""
    moved = _carried(position - f.map_T_base[:3, 3]).reshape(-1, POSE)
    cross = moved @ f.covariance[:POSE]
    own = (moved @ f.covariance[:POSE, :POSE] @ moved.T).reshape(len(position), 3, len(position), 3)
    each = np.arange(len(position))
    own[each, :, each] += covariance
    f.covariance = np.block([[f.covariance, cross.T], [cross, own.reshape(len(moved), -1)]])
    f.position = np.concatenate([f.position, position])


def keep(f: Filter, which: Bools) -> None:
    """Keep the landmarks in the mask `which` (N,)."""
    rows = np.concatenate([np.ones(f.head, bool), np.repeat(which, 3)])
    f.position, f.covariance = f.position[which], f.covariance[np.ix_(rows, rows)]
