"""The linear system of a graph whose parameters are the shared errors. It shows how the joint solution depends on them.

The shared errors are no variables of the graph. Their columns of the Jacobian are differences of the whitened residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements
from objslam.core.geometry import adjoint, inverse, log_se3
from objslam.core.statistics import CAUCHY_K, HUBER_K
from objslam.core.types import Association, Rays
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.factors.bearing import EQ1_SIGMA, ray_residuals, residual_axes
from objslam.graph.factors.localization import localization_covariance
from objslam.graph.factors.odometry import JUMP
from objslam.graph.factors.priors import ANCHOR
from objslam.graph.factors.tags import ROWS_FREE, ROWS_KNOWN

_ODOMETRY_SCALES = ("odometry.scale", "odometry.turn_scale")
"""Each derivative by one of these parameters consists of measured motions, and so contains the odometry's noise."""
_ALIKE = 10.0
"""The prediction of a motion by its neighbours is used if its covariance and theirs differ at most by this factor. The noise
of a motion changes its covariance by far less. With 3 or 5, one of twelve clean drives was pulled by 7 sigma, because the
choice itself then depends on the noise. With 30, a stereo rig that often stands lost its scale."""


@dataclass(frozen=True)
class Linearised:
    """A graph by `Measurements.whole`, with its variables at the values of its last solve.

    map_T_camera: (K, 4, 4). positions: (N, 3) m, NaN for a landmark outside the graph. used: (R,) the rays in the graph.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    measured: Measurements
    association: Association
    map_T_camera: Floats
    positions: Floats
    used: Bools

    @property
    def which(self) -> Ints:
        """(n,) the rays in the graph."""
        return np.flatnonzero(self.used)

    @property
    def landmarks(self) -> Ints:
        """(m,) the landmarks in the graph."""
        return np.flatnonzero(np.isfinite(self.positions[:, 0]))


@dataclass(frozen=True)
class LinearSystem:
    """The whitened Jacobian and residuals of a graph and its shared errors. The robust weights are kept fixed.

    The rows are in the order of `Measurements.whole`: bearings, ranges, landmark priors, motions, absolute poses, and ties
    of fiducials. jacobian: (M, D) by the landmarks, three columns each, by the poses, six columns each, then by fiducials.
    sides: (M, P) by the shared errors. residual: (M,). first_range, first_motion: the first rows of the ranges and of the
    motions. instruments: (M, P). At the optimum, the residuals do not correlate with these columns. They equal the sides,
    except for the scales of the odometry: their sides contain the noise of the odometry, and so do the residuals.
    """

    jacobian: sparse.csc_matrix
    sides: Floats
    instruments: Floats
    residual: Floats
    first_range: int
    first_motion: int

    def reduce(self) -> "ReducedSystem":
        """Eliminate poses and landmarks by a Schur complement. SolveError if the linear system is singular."""
        factored = factor(self.jacobian)
        sensitivity = -factored.solve(self.jacobian.T @ self.sides)
        newton = -factored.solve(self.jacobian.T @ self.residual)
        reduced, left = self.sides + self.jacobian @ sensitivity, self.residual + self.jacobian @ newton
        across, diagonal = np.einsum("mp,mp->p", self.instruments, reduced), np.einsum("mp,mp->p", reduced, reduced)
        signal = np.clip(across / np.maximum(diagonal, 1e-300), 0.0, 1.0)
        gradient, descent = -self.instruments.T @ left, -reduced.T @ left
        return ReducedSystem(reduced.T @ reduced, gradient, descent, signal, sensitivity, newton)


@dataclass(frozen=True)
class ReducedSystem:
    """The normal equations of the parameters with poses and landmarks eliminated.

    information: (P, P). gradient: (P,) the residuals against the instruments, zero at the optimum. descent: (P,) the
    negative gradient of the cost. signal: (P,) the share of the information's diagonal that is not noise. sensitivity: (D,
    P) the derivatives of all variables at their optimum by the parameters: first the landmarks, three rows each, then the
    poses, six rows each, then fiducials. newton: (D,) the remaining Newton step of the variables.
    """

    information: Floats
    gradient: Floats
    descent: Floats
    signal: Floats
    sensitivity: Floats
    newton: Floats


def linearise(
    of: Linearised, errors: CalibratedMeasurements, theta: Floats, which: Sequence[int] | None = None
) -> LinearSystem:
    """Return the linear system of a graph at its values, and at the shared errors theta (P,).

    which: the indices of the parameters in the system. None means all parameters.
    """
    which = range(len(theta)) if which is None else which
    names = [errors.names[k] for k in which]
    columns = 3 * len(of.landmarks) + 6 * len(of.map_T_camera)
    keyframes = of.measured.keyframes
    motions = 6 * int(keyframes.measured.sum()) if of.measured.motion is not None else 0
    absolute = 6 * (len(keyframes) if keyframes.localized_every else 1)
    ranged = int(np.isfinite(of.measured.rays.range[of.used]).sum())
    first_range = 2 * len(of.which)
    first_motion = first_range + ranged + 3 * len(of.landmarks)
    tied = np.zeros(0) if of.measured.tags is None else of.measured.tags.side[of.measured.tags.tied(of.landmarks)]
    known = np.isfinite(tied)
    columns += int(np.where(known, 6, 7).sum())
    ties = int(np.where(known, ROWS_KNOWN, ROWS_FREE).sum())
    jacobian, residual = _whitened(of.graph, of.values, first_motion + motions + absolute + ties, columns)
    sides = _parameter_columns(of, errors, theta, which, (len(residual), first_range, first_motion))
    instruments = _instruments(of, names, sides, slice(first_motion, first_motion + motions))
    return LinearSystem(jacobian, sides, instruments, residual, first_range, first_motion)


def factor(jacobian: sparse.csc_matrix) -> SuperLU:
    """Factor the normal equations of a sparse Jacobian. SolveError if they are singular."""
    try:
        return splu(
            sparse.csc_matrix(jacobian.T @ jacobian),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SolveError(f"the calibration's linear system has no single solution: {error}") from error


def _whitened(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, rows: int, columns: int
) -> tuple[sparse.csc_matrix, Floats]:
    """Return the whitened Jacobian (rows, columns) of a graph and its whitened residuals (rows,), in the factors' order."""
    linear = graph.linearize(values)
    row, column, value = linear.sparseJacobian_()  # The numbers start at 1. The last column is the right-hand side.
    row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
    side = column == columns
    residual = np.zeros(rows)
    residual[row[side]] = -value[side]
    return sparse.csc_matrix((value[~side], (row[~side], column[~side])), shape=(rows, columns)), residual


def _parameter_columns(
    of: Linearised, errors: CalibratedMeasurements, theta: Floats, which: Sequence[int], rows: tuple[int, int, int]
) -> Floats:
    """Return derivatives (M, p) of the whitened residuals by some parameters: central differences with fixed robust weights.

    rows: the number of rows, and the first rows of the ranges and of the motions.
    """
    measured, map_T_camera = of.measured, of.map_T_camera
    keyframes, rays, landmark = measured.keyframes, measured.rays.take(of.which), of.association.object[of.which]
    steps, ranged = np.flatnonzero(keyframes.measured), np.flatnonzero(np.isfinite(rays.range))
    seen = _seen(map_T_camera[rays.keyframe], of.positions[landmark])
    metric = measured.settings.joint.factor != "bearing"
    axes = residual_axes(rays.direction, _from(rays, seen), rays.offset, metric)
    bearing_root = _bearing_roots(rays, ray_residuals(rays.direction, _from(rays, seen), axes, metric), metric)
    range_, range_sigma = rays.range[ranged], rays.range_sigma[ranged]
    deviation = (np.linalg.norm(_from(rays, seen)[ranged], axis=1) - range_) / range_sigma
    range_root = 1 / range_sigma / np.sqrt(1 + (deviation / CAUCHY_K) ** 2)
    has_odometry = measured.motion is not None and len(steps) > 0
    motion_root = whitening(measured.odometry()[1][steps]) if has_odometry else np.zeros((0, 6, 6))
    moved = inverse(map_T_camera[:-1]) @ map_T_camera[1:]
    if has_odometry:
        motion_root = motion_root * _motion_weights(measured, moved, motion_root, steps)[:, None, None]
    absolute = map_T_camera if keyframes.localized_every else map_T_camera[:1]
    absolute_root = _absolute_roots(measured, absolute)

    def residuals(parameters: Floats) -> tuple[Floats, Floats, Floats]:
        images, other_rays, settings = errors.at(parameters, drift=False)
        other, other_rays = (
            measured.multiframes.keyframes(images),
            measured.multiframes.rays(images, other_rays.take(of.which)),
        )
        to_landmark = _from(other_rays, seen)
        bearings = (bearing_root * ray_residuals(other_rays.direction, to_landmark, axes, metric)).ravel()
        longer = other_rays.range[ranged] / range_
        distances = range_root * (np.linalg.norm(to_landmark[ranged], axis=1) - longer * range_) / longer
        parts = []
        if has_odometry and other.odom_T_base is not None:
            odom_T_camera = other.odom_T_base @ other.base_T_camera
            said = inverse(odom_T_camera[:-1]) @ odom_T_camera[1:]
            way = settings.odometry.floor_xy / measured.settings.odometry.floor_xy
            off = log_se3(inverse(said[steps]) @ moved[steps]) / np.repeat([1.0, way], 3)
            parts.append(np.einsum("kij,kj->ki", motion_root, off).ravel())
        off = log_se3(inverse(other.map_T_camera[: len(absolute)]) @ absolute)
        parts.append(np.einsum("kij,kj->ki", absolute_root, off).ravel())
        return bearings, distances, np.concatenate(parts)

    total, first_range, first_motion = rows
    result = np.zeros((total, len(which)))
    for column, k in enumerate(which):
        step = errors.steps[k]
        up, down = (residuals(theta + sign * step * np.eye(len(theta))[k]) for sign in (1, -1))
        bearings, distances, others = ((more - less) / (2 * step) for more, less in zip(up, down, strict=True))
        result[:first_range, column] = bearings
        result[first_range : first_range + len(ranged), column] = distances
        result[first_motion : first_motion + len(others), column] = others
    return result


def _instruments(of: Linearised, names: Sequence[str], sides: Floats, motions: slice) -> Floats:
    """Return the sides (M, p) of parameters. In the rows of the odometry's scales, neighbours predict the motions.

    The noise of a motion is both in its derivative by the scale and in its residual. Their product would bias the scale: up
    if the odometry measures the motion, down if it commands it. The neighbours move alike, and their noise is independent
    (instrumental variables; Fuller 1987, 1.4). The noise is also in the weight, because longer motions have more noise. So
    motions that were measured too short would weigh more. Hence the neighbours also predict the covariance, unless they move
    differently. Examples are a long way between two places where the robot stood, and neighbours of no duration.
    """
    which = [k for k, name in enumerate(names) if name in _ODOMETRY_SCALES]
    if not which or motions.start == motions.stop:
        return sides
    keyframes = of.measured.keyframes
    steps = np.flatnonzero(keyframes.measured)
    covariance = of.measured.odometry()[1][steps]
    root = whitening(covariance)
    to_base = adjoint(keyframes.base_T_camera[1:][steps])
    seconds = np.maximum(np.diff(keyframes.stamps)[steps], 0.0)
    in_base = to_base @ covariance @ np.swapaxes(to_base, 1, 2)
    near = from_neighbours(in_base.reshape(-1, 36), seconds).reshape(-1, 6, 6)
    size = np.einsum("kii->k", near) / np.einsum("kii->k", in_base)
    near = np.where(((size > 1 / _ALIKE) & (size < _ALIKE))[:, None, None], near, in_base)
    weight = np.swapaxes(to_base, 1, 2) @ np.linalg.inv(near) @ to_base
    instruments = sides.copy()
    for k in which:
        own = (to_base @ np.linalg.solve(root, sides[motions, k].reshape(-1, 6, 1)))[..., 0]
        told = np.linalg.solve(to_base, from_neighbours(own, seconds)[..., None])
        instruments[motions, k] = np.linalg.solve(np.swapaxes(root, 1, 2), weight @ told).ravel()
    return instruments


def from_neighbours(motions: Floats, seconds: Floats) -> Floats:
    """Predict motions (n, D) at the rate of the two motions before and the two after each. seconds: (n,) their durations."""

    def near(values: Floats) -> Floats:
        padded = np.pad(values, ((2, 2), (0, 0)))
        return np.asarray(sum(padded[i : i + len(values)] for i in (0, 1, 3, 4)))

    time = near(seconds[:, None])
    return np.asarray(np.where(time > 0, near(motions) / np.maximum(time, 1e-9), 0.0) * seconds[:, None])


def _seen(map_T_camera: Floats, positions: Floats) -> Floats:
    """Return positions (n, 3), m, in the frames of poses (n, 4, 4)."""
    return np.asarray(np.einsum("nji,nj->ni", map_T_camera[:, :3, :3], positions - map_T_camera[:, :3, 3]))


def _from(rays: Rays, seen: Floats) -> Floats:
    """Return positions (n, 3), m, relative to the points where their rays begin."""
    return seen if rays.offset is None else seen - rays.offset


def _bearing_roots(rays: Rays, residuals: Floats, metric: bool) -> Floats:
    """Return the factors (n, 1) that whiten the residuals (n, 2) of rays, with the weights of Huber's loss."""
    sigma = np.full(len(rays), EQ1_SIGMA) if metric else rays.sigma
    off = np.linalg.norm(residuals, axis=1) / sigma
    return np.asarray((np.sqrt(np.minimum(1.0, HUBER_K / np.maximum(off, 1e-12))) / sigma)[:, None])


def _motion_weights(measured: Measurements, moved: Floats, roots: Floats, steps: Ints) -> Floats:
    """Return the square roots (n,) of the weights that the loss of motions gives them, 1 without a loss.

    moved: (P-1, 4, 4) the solved motions. roots: (n, 6, 6) that whiten the motions `steps` (n,).
    """
    off = log_se3(inverse(measured.odometry()[0][steps]) @ moved[steps])
    squared = (np.einsum("kij,kj->ki", roots, off) ** 2).sum(axis=1)
    return np.where(measured.seen_twice[steps], 1 / np.sqrt(1 + squared / JUMP**2), 1.0)


def whitening(covariance: Floats) -> Floats:
    """Return upper triangular matrices (n, 6, 6) that whiten residuals with covariances (n, 6, 6), as GTSAM does."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


def _absolute_roots(measured: Measurements, poses: Floats) -> Floats:
    """Return matrices (n, 6, 6) that whiten absolute poses (n, 4, 4), with the weights of Huber's loss. The anchor has no
    loss."""
    keyframes = measured.keyframes
    if not keyframes.localized_every:
        return np.eye(6)[None] / ANCHOR
    roots = whitening(localization_covariance(keyframes, measured.settings))
    off = np.linalg.norm(np.einsum("kij,kj->ki", roots, log_se3(inverse(keyframes.map_T_camera) @ poses)), axis=1)
    return np.asarray(roots * np.sqrt(np.minimum(1.0, HUBER_K / np.maximum(off, 1e-12)))[:, None, None])
