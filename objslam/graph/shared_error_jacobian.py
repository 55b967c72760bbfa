"""How the joint solution depends on the errors that all measurements share: the linear system of a graph with them in it.

The parameters are no variables of the graph. Their columns of the Jacobian are differences of the whitened residuals.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, kind
from objslam.core.geometry import inverse, log_se3
from objslam.core.statistics import CAUCHY_K, HUBER_K
from objslam.core.types import Keyframes, Rays
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.factors.bearing import bearings
from objslam.graph.factors.localization import localization_covariance
from objslam.graph.factors.noise import robust
from objslam.graph.factors.priors import ANCHOR


@dataclass(frozen=True)
class ReducedSystem:
    """The normal equations of the parameters with poses and landmarks eliminated.

    information: (P, P). gradient: (P,), the negative gradient of the cost at the linearisation. sensitivity: (D, P), the
    derivatives of all variables at their optimum by the parameters: first the landmarks, three rows each, then the poses,
    six rows each. newton: (D,), what is left of the variables' own step.
    """

    information: Floats
    gradient: Floats
    sensitivity: Floats
    newton: Floats


def reduce_system(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    measured: Measurements,
    errors: CalibratedMeasurements,
    theta: Floats,
    which: Ints,
    landmark: Ints,
    positions: Floats,
    map_T_camera: Floats,
) -> ReducedSystem:
    """Linearise a graph and its shared errors theta (P,), and eliminate poses and landmarks by a Schur complement.

    Args:
        graph: as `Measurements.factors` makes it of the rays `which` (n,), with the poses X and n landmarks L in `values`.
        landmark: (n,) the landmark of each of these rays.
        positions, map_T_camera: (N, 3), NaN where an object is not in the graph, and (K, 4, 4), as in `values`.
    Raises:
        SolveError: the linear system is singular.
    """
    landmarks = int(np.isfinite(positions[:, 0]).sum())
    columns = 3 * landmarks + 6 * len(map_T_camera)
    jacobian, residual = _linear_system(graph, values, columns)
    sides = _parameter_columns(values, measured, errors, theta, which, landmark, positions, map_T_camera, len(residual))
    try:
        factored = splu(
            sparse.csc_matrix(jacobian.T @ jacobian),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise SolveError(f"the calibration's linear system has no single solution: {error}") from error
    sensitivity = -factored.solve(jacobian.T @ sides)
    newton = -factored.solve(jacobian.T @ residual)
    reduced = sides + jacobian @ sensitivity
    return ReducedSystem(reduced.T @ reduced, -reduced.T @ (residual + jacobian @ newton), sensitivity, newton)


def _linear_system(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, columns: int | None
) -> tuple[sparse.csc_matrix, Floats]:
    """The whitened Jacobian (M, columns) of a graph, and its whitened residuals (M,), in the order of the factors."""
    linear = graph.linearize(values)
    row, column, value = linear.sparseJacobian_()  # numbers from 1; the column after the last holds the right-hand side
    row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
    rows = sum(graph.at(i).dim() for i in range(graph.size()))
    columns = int(column.max()) if columns is None else columns
    side = column == columns
    residual = np.zeros(rows)
    residual[row[side]] = -value[side]
    return sparse.csc_matrix((value[~side], (row[~side], column[~side])), shape=(rows, columns)), residual


def _parameter_columns(
    values: gtsam.Values,
    measured: Measurements,
    errors: CalibratedMeasurements,
    theta: Floats,
    which: Ints,
    landmark: Ints,
    positions: Floats,
    map_T_camera: Floats,
    rows: int,
) -> Floats:
    """(M, P) derivatives of the whitened residuals by the parameters: central differences, robust weights held.

    The rows are in the order of `Measurements.factors`: bearings, ranges, landmark priors, motions, absolute poses.
    """
    keyframes, rays = measured.keyframes, measured.rays.take(which)
    steps, ranged = np.flatnonzero(keyframes.measured), np.flatnonzero(np.isfinite(rays.range))
    rays_of_range, odometry = rays.take(ranged), measured.settings.odometry
    distance = np.linalg.norm(positions[landmark[ranged]] - map_T_camera[rays_of_range.keyframe, :3, 3], axis=1)
    deviation = (distance - rays_of_range.range) / rays_of_range.range_sigma
    range_root = 1 / rays_of_range.range_sigma / np.sqrt(1 + (deviation / CAUCHY_K) ** 2)
    motion_root = _roots(measured.odometry()[1][steps]) if len(steps) else np.zeros((0, 6, 6))
    moved = inverse(map_T_camera[:-1]) @ map_T_camera[1:]
    absolute = map_T_camera if keyframes.localized_every else map_T_camera[:1]
    absolute_root = _absolute_roots(keyframes, measured, absolute)

    def residuals(parameters: Floats) -> list[Floats]:
        other, other_rays, settings = errors.at(parameters, drift=False)
        longer = other_rays.range[which[ranged]] / rays_of_range.range
        parts = [range_root * (distance - longer * rays_of_range.range) / longer]
        if other.odom_T_base is not None and len(steps):
            odom_T_camera = other.odom_T_base @ other.base_T_camera
            said = inverse(odom_T_camera[:-1]) @ odom_T_camera[1:]
            turn, way = settings.odometry.floor_yaw / odometry.floor_yaw, settings.odometry.floor_xy / odometry.floor_xy
            off = log_se3(inverse(said[steps]) @ moved[steps]) / np.repeat([turn, way], 3)
            parts.append(np.einsum("kij,kj->ki", motion_root, off).ravel())
        off = log_se3(inverse(other.map_T_camera[: len(absolute)]) @ absolute)
        return [*parts, np.einsum("kij,kj->ki", absolute_root, off).ravel()]

    result = np.zeros((rows, len(theta)))
    first_range, first_motion = 2 * len(which), rows - 6 * (len(steps) + len(absolute))
    for k, step in enumerate(errors.steps):
        ahead, behind = (theta + sign * step * np.eye(len(theta))[k] for sign in (1, -1))
        (up, *ups), (down, *downs) = residuals(ahead), residuals(behind)
        result[first_range : first_range + len(ranged), k] = (up - down) / (2 * step)
        result[first_motion:, k] = (np.concatenate(ups) - np.concatenate(downs)) / (2 * step)
        if kind(errors.names[k]) == "focal":
            sides = [
                _bearing_residuals(errors.at(side, drift=False)[1].take(which), landmark, values) for side in (ahead, behind)
            ]
            result[:first_range, k] = (sides[0] - sides[1]) / (2 * step)
    return result


def _bearing_residuals(rays: Rays, landmark: Ints, values: gtsam.Values) -> Floats:
    """(2n,) whitened residuals of bearings under Huber's loss."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in bearings(rays.keyframe, rays.direction, landmark, robust("huber", rays.sigma, 2)):
        graph.push_back(factor)
    return _linear_system(graph, values, None)[1]


def _roots(covariance: Floats) -> Floats:
    """Upper triangular (n, 6, 6) that whiten residuals with covariances (n, 6, 6), as GTSAM's noise models do."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


def _absolute_roots(keyframes: Keyframes, measured: Measurements, poses: Floats) -> Floats:
    """What whitens the residuals of absolute poses (n, 4, 4), with the weights of Huber's loss; the anchor has no loss."""
    if not keyframes.localized_every:
        return np.eye(6)[None] / ANCHOR
    roots = _roots(localization_covariance(keyframes, measured.settings))
    off = np.linalg.norm(np.einsum("kij,kj->ki", roots, log_se3(inverse(keyframes.map_T_camera) @ poses)), axis=1)
    return np.asarray(roots * np.sqrt(np.minimum(1.0, HUBER_K / np.maximum(off, 1e-12)))[:, None, None])
