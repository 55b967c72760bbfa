"""The graph of a joint solve as arrays: its whitened residuals and its sparse Jacobian, without an object for each factor.

A calibration solves the same graph for many values of the shared errors. The construction of a GTSAM graph takes longer than
its solution, so these solves use arrays. Residuals, noise, losses and derivatives are from `Measurements.factors`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy import sparse

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse, lengths, log_se3
from objslam.core.rotation import cross
from objslam.core.statistics import CAUCHY_K
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements, RowsOfKind
from objslam.graph.factors.bearing import EQ1_SIGMA, ray_jacobians, ray_residuals, residual_axes
from objslam.graph.factors.localization import localization_covariance
from objslam.graph.factors.odometry import JUMP
from objslam.graph.factors.priors import ANCHOR
from objslam.graph.factors.residual_algebra import by_end, huber_roots, whitening
from objslam.graph.least_squares.chain import ChainRows, is_chain
from objslam.graph.tags.square_rows import SquareRows


@dataclass(frozen=True)
class JointRows:
    """A graph at some values: M rows in the order of `Measurements.factors`, then those of `Measurements.further_rows`.

    The robust weights are in the rows. residual: (M,) whitened. cost: half the sum of the squared residuals, with the robust
    losses. derive: returns `jacobian` and `chain`.
    """

    residual: Floats
    cost: float
    derive: Callable[[], tuple[sparse.csr_matrix, ChainRows | None]]

    @cached_property
    def _derived(self) -> tuple[sparse.csr_matrix, ChainRows | None]:
        """The derivatives, computed at their first use. After the last step of a solve, or a refused step, none are used."""
        return self.derive()

    @property
    def jacobian(self) -> sparse.csr_matrix:
        """(M, D) the derivatives of the residuals. First, each landmark has three columns. Then, each pose has six."""
        return self._derived[0]

    @property
    def chain(self) -> ChainRows | None:
        """The same derivatives by kind. None unless the poses are a chain that sees few landmarks."""
        return self._derived[1]


@dataclass(frozen=True)
class JointGraph:
    """The measurements of a joint solve with Huber's loss, or with bearings of Gaussian noise.

    measured: all measurements. which: (n,) the rays of `measured` that are in the graph. rays: these n rays. landmarks: (m,)
    the landmarks in the graph. landmark: (n,) the row of each ray's landmark in `landmarks`. weak: (m, 3) m, the means of
    the landmarks' weak priors. pattern: the columns of all entries of the Jacobian, row by row, and the first entry of each
    row. gaussian: whether the bearings have Gaussian noise, without a robust loss.
    """

    measured: Measurements
    which: Ints
    rays: Rays
    landmarks: Ints
    landmark: Ints
    weak: Floats
    pattern: tuple[Ints, Ints]
    gaussian: bool = False

    @classmethod
    def of(
        cls, measured: Measurements, association: Association, used: Bools, positions: Floats, gaussian: bool = False
    ) -> Self:
        """Make the graph of the rays `used` (R,). Landmarks without a position (N, 3) are not in it."""
        which, landmarks = np.flatnonzero(used), np.flatnonzero(np.isfinite(positions[:, 0]))
        landmark = np.searchsorted(landmarks, association.object[which])
        rays = measured.rays.take(which)
        pattern = _pattern(measured, rays, landmark, landmarks)
        return cls(measured, which, rays, landmarks, landmark, positions[landmarks], pattern, gaussian)

    def measuring(self, measured: Measurements) -> Self:
        """Return the graph of the same rays and landmarks with other measured values."""
        rays, pattern = measured.rays.take(self.which), self.pattern
        if (measured.localized_motions is None) != (self.measured.localized_motions is None):
            pattern = _pattern(measured, rays, self.landmark, self.landmarks)
        return replace(self, measured=measured, rays=rays, pattern=pattern)

    @cached_property
    def further(self) -> tuple[SquareRows, *tuple[RowsOfKind, ...]]:
        """The kinds of factors that make their own rows. The first kind is the fiducials, whose corners are landmarks."""
        return self.measured.further_rows(self.landmarks)

    @cached_property
    def ranged(self) -> Ints:
        """(q,) the rays with a range."""
        return _ranged(self.rays)

    @cached_property
    def moves(self) -> tuple[Ints, Ints]:
        """(s,), (s,) the poses before and after each of the motions that the odometry measured."""
        return _moves(self.measured)

    @property
    def first_range(self) -> int:
        """The first row of the ranges."""
        return 2 * len(self.rays)

    @property
    def first_motion(self) -> int:
        """The first row of the motions."""
        return self.first_range + len(self.ranged) + self.weak.size

    @property
    def first_further(self) -> int:
        """The first row of the kinds in `further`."""
        absolute = len(self.measured.keyframes) if self.measured.keyframes.localized_every else 1
        return self.first_motion + 6 * (len(self.moves[0]) + absolute)

    @cached_property
    def is_chain(self) -> bool:
        """Whether the poses are a chain that sees few landmarks and nothing else."""
        return len(self.pattern[1]) - 1 == self.first_further and is_chain(len(self.weak), *self.moves)

    @cached_property
    def motion_roots(self) -> Floats:
        """(s, 6, 6) upper triangular matrices that whiten the motions."""
        of = self.measured.motions
        return whitening(of.covariance) if of is not None and len(of) else np.zeros((0, 6, 6))

    @cached_property
    def _absolute_roots(self) -> Floats:
        """(a, 6, 6) matrices that whiten the absolute poses: all poses, or the anchor alone without a localisation."""
        keyframes = self.measured.keyframes
        if not keyframes.localized_every:
            return np.eye(6)[None] / ANCHOR
        return whitening(localization_covariance(keyframes, self.measured.settings))

    @property
    def _metric(self) -> bool:
        """Whether the residuals of rays are distances (m, Eq. 1), not angles."""
        return self.measured.settings.joint.factor != "bearing"

    @cached_property
    def blocks(self) -> Ints:
        """(D,) the variable of each column: first the landmarks, then the poses."""
        m, poses = len(self.weak), len(self.measured.keyframes)
        return np.concatenate([np.repeat(np.arange(m), 3), np.repeat(m + np.arange(poses), 6)])

    def seen(self, map_T_camera: Floats, landmarks: Floats) -> Floats:
        """Return the landmark (n, 3), m, of each ray, in the camera frame of the ray's pose."""
        poses = map_T_camera[self.rays.keyframe]
        return np.asarray(np.einsum("nji,nj->ni", poses[:, :3, :3], landmarks[self.landmark] - poses[:, :3, 3]))

    def bearing_axes(self, to_landmark: Floats) -> Floats:
        """Return the axes (n, 3, 2) of the residuals of rays. to_landmark: (n, 3) from the origin of each ray to its
        landmark."""
        return residual_axes(self.rays.direction, to_landmark, self.rays.offset, self._metric)

    def bearing_residuals(self, directions: Floats, to_landmark: Floats, axes: Floats) -> Floats:
        """Return the residuals (n, 2), rad or m, of rays with directions (n, 3)."""
        return ray_residuals(directions, to_landmark, axes, self._metric)

    def bearing_roots(self, residuals: Floats) -> tuple[Floats, Floats]:
        """Return the factors (n, 1) that whiten residuals (n, 2) and weigh them by the loss. Also return the costs (n,)."""
        sigma = np.full(len(self.rays), EQ1_SIGMA) if self._metric else self.rays.sigma
        size = lengths(residuals) / sigma
        weight, cost = (np.ones_like(size), size**2 / 2) if self.gaussian else huber_roots(size)
        return (weight / sigma)[:, None], cost

    def range_roots(self, distances: Floats) -> tuple[Floats, Floats]:
        """Return the factors (q,) that whiten the residuals of distances (q,), m, and weigh them by Cauchy's loss. Also
        return the costs (q,)."""
        sigma = self.rays.range_sigma[self.ranged]
        square = ((distances - self.rays.range[self.ranged]) / sigma / CAUCHY_K) ** 2
        return 1 / sigma / np.sqrt(1 + square), CAUCHY_K**2 / 2 * np.log1p(square)

    def absolute_roots(self, map_T_camera: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the residuals (a, 6) of absolute poses, the matrices (a, 6, 6) that whiten them, and their costs (a,).

        The anchor has no loss. With a localisation, all poses have Huber's loss, whose weights are in the matrices.
        """
        keyframes, roots = self.measured.keyframes, self._absolute_roots
        off = log_se3(inverse(keyframes.map_T_camera[: len(roots)]) @ map_T_camera[: len(roots)])
        size = lengths((roots @ off[..., None])[..., 0])
        if not keyframes.localized_every:
            return off, roots, size**2 / 2
        weight, cost = huber_roots(size)
        return off, roots * weight[:, None, None], cost

    def rows(self, map_T_camera: Floats, landmarks: Floats) -> JointRows:
        """Return the rows at poses (P, 4, 4) and positions (m, 3), m."""
        rays, ranged, weakly = self.rays, self.ranged, 1 / self.measured.settings.joint.prior_sigma
        seen = self.seen(map_T_camera, landmarks)
        to_landmark = from_origins(rays, seen)
        axes = self.bearing_axes(to_landmark)
        off = self.bearing_residuals(rays.direction, to_landmark, axes)
        roots, ray_cost = self.bearing_roots(off)
        distance = lengths(to_landmark[ranged])
        range_root, range_cost = self.range_roots(distance)
        moves = self._moves(map_T_camera)
        further = [kind.rows(map_T_camera, landmarks) for kind in self.further]
        apart, absolute_roots, absolute_cost = self.absolute_roots(map_T_camera)
        held = (absolute_roots @ apart[..., None]).ravel()
        weak = (landmarks - self.weak).ravel() * weakly
        past = range_root * (distance - rays.range[ranged])
        parts = (roots * off).ravel(), past, weak, moves.residual.ravel(), held, *(own.ravel() for own, _, _ in further)
        cost = ray_cost.sum() + range_cost.sum() + absolute_cost.sum() + moves.cost.sum() + weak @ weak / 2
        cost += sum(cost for _, _, cost in further)

        def derive() -> tuple[sparse.csr_matrix, ChainRows | None]:
            columns, first = self.pattern
            data, ends = np.empty(len(columns)), np.cumsum([18 * len(rays), 9 * len(ranged), weak.size, moves.size])
            bearings, ranges, by_weak, by_moves, others = np.split(data, ends)
            to_map = np.swapaxes(map_T_camera[rays.keyframe, :3, :3], 1, 2)
            by_seen = roots[:, :, None] * ray_jacobians(rays.direction, to_landmark, axes, rays.offset, self._metric)
            _put_by_seen(bearings.reshape(-1, 2, 9), by_seen, seen[:, None], to_map)
            by_seen = (range_root / np.maximum(distance, 1e-12))[:, None] * to_landmark[ranged]
            _put_by_seen(ranges.reshape(-1, 1, 9), by_seen[:, None], seen[ranged, None], to_map[ranged])
            by_weak[:] = weakly
            moves.put(by_moves.reshape(-1, 6, 12))
            by_absolute = (absolute_roots @ by_end(apart)).ravel()
            np.concatenate([by_absolute, *(derivatives.ravel() for _, derivatives, _ in further)], out=others)
            chain = None
            if self.is_chain:
                count = len(landmarks), len(map_T_camera)
                which = self.landmark, rays.keyframe, ranged, *self.moves
                by_rays = bearings.reshape(-1, 2, 9), ranges.reshape(-1, 1, 9)
                chain = ChainRows(
                    *count, *which, *by_rays, by_weak, by_moves.reshape(-1, 6, 12), by_absolute.reshape(-1, 6, 6)
                )
            shape = len(first) - 1, len(self.blocks)
            if data.all():
                return sparse.csr_matrix((data, columns, first), shape=shape), chain
            found = sparse.csr_matrix((data.copy(), columns.copy(), first.copy()), shape=shape)
            found.eliminate_zeros()  # On a plane, half of the entries are zero.
            return found, chain

        return JointRows(np.concatenate(parts), float(cost), derive)

    def motion_weights(self, map_T_camera: Floats) -> Floats:
        """Return the roots (s,) of the weights of motions.

        A motion that fiducials also measure has Cauchy's loss. The weights of other motions are 1.
        """
        return self._moves(map_T_camera).weight

    @cached_property
    def _back(self) -> Floats:
        """(s, 4, 4) the inverses of the measured motions."""
        of = self.measured.motions
        return np.zeros((0, 4, 4)) if of is None else inverse(of.motion)

    def _moves(self, map_T_camera: Floats) -> "_Moves":
        """Return the motions at poses (P, 4, 4)."""
        before, after = self.moves
        moved = inverse(map_T_camera[before]) @ map_T_camera[after]
        off = log_se3(self._back @ moved)
        whitened = (self.motion_roots @ off[..., None])[..., 0]
        square = np.einsum("si,si->s", whitened, whitened)
        robust = self.measured.seen_twice
        if not robust.any():
            return _Moves(moved, off, self.motion_roots, np.ones(len(off)), whitened, square / 2)
        ratio = square / JUMP**2
        weight = np.where(robust, 1 / np.sqrt(1 + ratio), 1.0)
        cost = np.where(robust, JUMP**2 * np.log1p(ratio), square) / 2
        return _Moves(moved, off, weight[:, None, None] * self.motion_roots, weight, weight[:, None] * whitened, cost)


@dataclass(frozen=True)
class _Moves:
    """The motions by odometry at some poses.

    moved: (s, 4, 4) the motions of the poses. off: (s, 6) the twists from the measured motions. weight: (s,) the roots of
    the robust weights. roots: (s, 6, 6) matrices that whiten and weigh the twists. residual: (s, 6) whitened. cost: (s,).
    """

    moved: Floats
    off: Floats
    roots: Floats
    weight: Floats
    residual: Floats
    cost: Floats

    @property
    def size(self) -> int:
        """The number of entries that `put` writes."""
        return 72 * len(self.off)

    def put(self, rows: Floats) -> None:
        """Write the derivatives (s, 6, 12) of the residuals by the poses before and after."""
        after = self.roots @ by_end(self.off)
        rows[:, :, 6:] = after
        np.negative(after @ adjoint(inverse(self.moved)), out=rows[:, :, :6])


def _put_by_seen(rows: Floats, by_seen: Floats, seen: Floats, to_map: Floats) -> None:
    """Write the derivatives (n, k, 9) of k residuals of each ray by its landmark and its pose.

    by_seen: (n, k, 3) the derivatives by the landmark `seen` (n, 1, 3), both in the camera frame. to_map: (n, 3, 3) the
    rotations from map to this frame.
    """
    np.matmul(by_seen, to_map, out=rows[..., :3])
    rows[..., 3:6] = cross(by_seen, seen)
    np.negative(by_seen, out=rows[..., 6:])


def _ranged(rays: Rays) -> Ints:
    return np.flatnonzero(np.isfinite(rays.range))


def _moves(measured: Measurements) -> tuple[Ints, Ints]:
    of = measured.motions
    return (np.zeros(0, dtype=np.int64),) * 2 if of is None else (of.before, of.after)


def _pattern(measured: Measurements, rays: Rays, landmark: Ints, landmarks: Ints) -> tuple[Ints, Ints]:
    """Return the columns of all entries of the Jacobian, row by row, and the first entry of each row."""
    first_pose = 3 * len(landmarks)
    on_landmark = 3 * landmark[:, None] + np.arange(3)
    seen = np.hstack([on_landmark, first_pose + 6 * rays.keyframe[:, None] + np.arange(6)])
    moved = first_pose + np.hstack([6 * pose[:, None] + np.arange(6) for pose in _moves(measured)])
    localized = len(measured.keyframes) if measured.keyframes.localized_every else 1
    absolute = first_pose + 6 * np.arange(localized)[:, None] + np.arange(6)
    parts = (
        np.repeat(seen, 2, axis=0),
        seen[_ranged(rays)],
        np.arange(first_pose)[:, None],
        np.repeat(moved, 6, axis=0),
        np.repeat(absolute, 6, axis=0),
        *(np.repeat(kind.columns, kind.rows_each, axis=0) for kind in measured.further_rows(landmarks)),
    )
    lengths = np.concatenate([np.full(len(part), part.shape[1]) for part in parts])
    columns = np.concatenate([part.ravel() for part in parts])
    return columns.astype(np.int32), np.append(0, np.cumsum(lengths)).astype(np.int32)


def from_origins(rays: Rays, seen: Floats) -> Floats:
    """Return positions (n, 3), m, relative to the points where their rays begin."""
    return seen if rays.offset is None else seen - rays.offset
