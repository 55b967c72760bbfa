"""The linear system of a graph whose parameters are the shared errors. It shows how the joint solution depends on them.

The shared errors are no variables of the graph. Their columns of the Jacobian are differences of the whitened residuals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, kind
from objslam.core.geometry import adjoint, inverse, log_se3
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.least_squares.joint_rows import JointGraph, JointRows, from_origins
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order

_ODOMETRY_SCALES = ("odometry.scale", "odometry.turn_scale")
"""Each derivative by one of these parameters consists of measured motions, and so contains the odometry's noise."""
_SHORT = 1e-3
"""The step of a derivative, as a share of `errors.steps`. With a larger share, the derivative contains more of the
curvature. With a share below 1e-6, it contains rounding errors."""
_ALIKE = 10.0
"""The neighbours of a motion predict its covariance if the prediction and the motion's own covariance differ at most by this
factor. The noise of a motion changes its covariance by far less. With 3 or 5, one of twelve clean drives was pulled by 7
sigma, because the choice itself then depends on the noise. With 30, a stereo rig that often stands lost its scale."""


@dataclass(frozen=True)
class Linearised:
    """The graph of a joint solve with Huber's loss, and values of its variables.

    map_T_camera: (K, 4, 4). positions: (N, 3) m, NaN for a landmark outside the graph. used: (R,) the rays in the graph.
    order: (D,) the order in which the columns of the Jacobian are eliminated. known: the graph, which states with the same
    measurements share. None means that they are not known yet.
    """

    measured: Measurements
    association: Association
    map_T_camera: Floats
    positions: Floats
    used: Bools
    order: Ints | None = None
    known: JointGraph | None = None

    @property
    def which(self) -> Ints:
        """(n,) the rays in the graph."""
        return np.flatnonzero(self.used)

    @property
    def landmarks(self) -> Ints:
        """(m,) the landmarks in the graph."""
        return np.flatnonzero(np.isfinite(self.positions[:, 0]))

    @cached_property
    def graph(self) -> JointGraph:
        """The graph. The means of the weak priors of landmarks are the `positions` at which it was made."""
        if self.known is not None:
            return self.known
        return JointGraph.of(self.measured, self.association, self.used, self.positions)

    @cached_property
    def rows(self) -> JointRows:
        """The rows of the graph at the values."""
        return self.graph.rows(self.map_T_camera, self.positions[self.landmarks])

    @cached_property
    def normal(self) -> NormalEquations:
        """The normal equations of `rows`. SolveError if they are singular."""
        jacobian = self.rows.jacobian
        order = elimination_order(jacobian, self.graph.blocks) if self.order is None else self.order
        return NormalEquations.of(jacobian, order)


@dataclass(frozen=True)
class LinearSystem:
    """The whitened Jacobian and residuals of a graph and its shared errors. The robust weights are kept fixed.

    The rows are in the order of `Measurements.factors`: bearings, ranges, landmark priors, motions, absolute poses. The
    corners of fiducials are last. jacobian: (M, D) by the landmarks, three columns each, then by the poses, six columns
    each. normal: the normal equations of the Jacobian. sides: (M, P) by the shared errors. residual: (M,). first_range,
    first_motion: the first rows of the ranges and of the motions. instruments: (M, P). At the optimum, the residuals do not
    correlate with the instruments. The instruments equal the sides, except for the scales of the odometry: the sides of the
    scales contain the noise of the odometry, and so do the residuals.
    """

    jacobian: sparse.csr_matrix
    sides: Floats
    instruments: Floats
    residual: Floats
    first_range: int
    first_motion: int
    normal: NormalEquations

    def reduce(self) -> "ReducedSystem":
        """Eliminate poses and landmarks by a Schur complement."""
        both = -self.normal.solve(self.jacobian.T @ np.column_stack([self.sides, self.residual]))
        sensitivity, newton = both[:, :-1], both[:, -1]
        reduced, left = self.sides + self.jacobian @ sensitivity, self.residual + self.jacobian @ newton
        across, diagonal = np.einsum("mp,mp->p", self.instruments, reduced), np.einsum("mp,mp->p", reduced, reduced)
        signal = np.clip(across / np.maximum(diagonal, 1e-300), 0.0, 1.0)
        gradient, descent = -self.instruments.T @ left, -reduced.T @ left
        return ReducedSystem(reduced.T @ reduced, gradient, descent, signal, sensitivity, newton)


@dataclass(frozen=True)
class ReducedSystem:
    """The normal equations of the parameters with poses and landmarks eliminated.

    information: (P, P). gradient: (P,) minus the product of the instruments and the residuals, zero at the optimum. descent:
    (P,) the negative gradient of the cost. signal: (P,) the share of the information's diagonal that is not noise.
    sensitivity: (D, P) the derivatives of all variables at their optimum by the parameters: first the landmarks, three rows
    each, then the poses, six rows each. newton: (D,) the remaining Newton step of the variables.
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
    """Return the linear system of a graph at its values, and at the shared errors theta (P,). SolveError if it is singular.

    which: the indices of the parameters in the system. None means all parameters.
    """
    which = range(len(theta)) if which is None else which
    names = [errors.names[k] for k in which]
    graph, rows = of.graph, of.rows
    sides = _parameter_columns(of, errors, theta, which)
    motions = slice(graph.first_motion, graph.first_motion + 6 * len(graph.steps))
    instruments = _instruments(of, names, sides, motions)
    return LinearSystem(rows.jacobian, sides, instruments, rows.residual, graph.first_range, graph.first_motion, of.normal)


def _parameter_columns(of: Linearised, errors: CalibratedMeasurements, theta: Floats, which: Sequence[int]) -> Floats:
    """Return derivatives (M, p) of the whitened residuals by some parameters. The robust weights are kept fixed.

    A derivative by a clock is a central difference, because velocities change abruptly. The measurements are smooth
    functions of the other parameters. So a difference over a short step (`_SHORT`) is exact enough there.
    """
    parts, joined = _parts(of), of.measured.multiframes
    result = np.zeros((len(of.rows.residual), len(which)))

    def measured(theta: Floats) -> tuple[Keyframes, Rays, Settings]:
        images, rays, settings = errors.at(theta, drift=False)
        return joined.keyframes(images), joined.rays(images, rays.take(of.which)), settings

    here = measured(theta)
    for column, k in enumerate(which):
        clock = kind(errors.names[k]) == "clock"
        step = errors.steps[k] * (1.0 if clock else _SHORT)
        moved = step * np.eye(len(theta))[k]
        sides, apart = (measured(theta + moved), measured(theta - moved) if clock else here), step * (2 if clock else 1)
        for part in parts:
            ahead, behind = (part.measured(*side) for side in sides)
            if any(not np.array_equal(one, other) for one, other in zip(ahead, behind, strict=True)):
                change = (part.residuals(*ahead) - part.residuals(*behind)).ravel()
                result[part.first : part.first + len(change), column] = change / apart
    return result


@dataclass(frozen=True)
class _Part:
    """The rows of one kind of measurement, from the row `first` on.

    measured: returns the measured values of these rows. Parameters that do not change the values have no derivative here,
    and most parameters change only one kind of measurement. residuals: returns the whitened residuals of measured values.
    """

    first: int
    measured: Callable[[Keyframes, Rays, Settings], tuple[Floats, ...]]
    residuals: Callable[..., Floats]


def _parts(of: Linearised) -> tuple[_Part, ...]:
    """Return the kinds of measurements that shared errors may change."""
    graph, map_T_camera = of.graph, of.map_T_camera
    steps, ranged = graph.steps, graph.ranged
    seen = graph.seen(map_T_camera, of.positions[of.landmarks])
    to_landmark = from_origins(graph.rays, seen)
    axes = graph.bearing_axes(to_landmark)
    bearing_root, _ = graph.bearing_roots(graph.bearing_residuals(graph.rays.direction, to_landmark, axes))
    range_ = graph.rays.range[ranged]
    range_root, _ = graph.range_roots(np.linalg.norm(to_landmark[ranged], axis=1))
    moved = (inverse(map_T_camera[:-1]) @ map_T_camera[1:])[steps]
    motion_weight, _ = graph.motion_weights(map_T_camera)
    floor = of.measured.settings.odometry.floor_xy
    _, absolute_root, _ = graph.absolute_roots(map_T_camera)
    absolute = map_T_camera[: len(absolute_root)]

    def bearings(direction: Floats, to_landmark: Floats) -> Floats:
        return bearing_root * graph.bearing_residuals(direction, to_landmark, axes)

    def distances(measured: Floats, to_landmark: Floats) -> Floats:
        return np.asarray(range_root * (np.linalg.norm(to_landmark, axis=1) - measured) / (measured / range_))

    def said(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        if not len(steps) or keyframes.odom_T_base is None:
            return ()
        odom_T_camera = keyframes.odom_T_base @ keyframes.base_T_camera
        return (inverse(odom_T_camera[:-1]) @ odom_T_camera[1:])[steps], np.array(settings.odometry.floor_xy / floor)

    def motions(motion: Floats, way: Floats) -> Floats:
        off = log_se3(inverse(motion) @ moved) / np.repeat([1.0, float(way)], 3)
        return motion_weight[:, None] * np.einsum("kij,kj->ki", graph.motion_roots, off)

    def poses(measured: Floats) -> Floats:
        return np.einsum("kij,kj->ki", absolute_root, log_se3(inverse(measured) @ absolute))

    return (
        _Part(0, lambda _, rays, settings: (rays.direction, from_origins(rays, seen)), bearings),
        _Part(
            graph.first_range,
            lambda _, rays, settings: (rays.range[ranged], from_origins(rays, seen)[ranged]),
            distances,
        ),
        _Part(graph.first_motion, said, motions),
        _Part(
            graph.first_motion + 6 * len(steps),
            lambda keyframes, rays, settings: (keyframes.map_T_camera[: len(absolute)],),
            poses,
        ),
    )


def _instruments(of: Linearised, names: Sequence[str], sides: Floats, motions: slice) -> Floats:
    """Return the instruments (M, p): the sides, but in the columns of odometry scales, neighbours predict the motions.

    The noise of a motion is both in its derivative by the scale and in its residual. Their product would bias the scale: up
    if the odometry measures the motion, down if it commands it. The neighbours move alike, and their noise is independent
    (instrumental variables; Fuller 1987, 1.4). The noise is also in the weight, because longer motions have more noise. So
    motions that were measured too short would weigh more. Hence the neighbours also predict the covariance, unless they move
    differently. Examples of such motions are a long way between two places where the robot stood, and a motion whose
    neighbours have no duration.
    """
    which = [k for k, name in enumerate(names) if name in _ODOMETRY_SCALES]
    if not which or motions.start == motions.stop:
        return sides
    keyframes, steps = of.measured.keyframes, of.graph.steps
    robust, _ = of.graph.motion_weights(of.map_T_camera)
    root = robust[:, None, None] * of.graph.motion_roots
    covariance = of.measured.odometry()[1][steps]
    to_base = adjoint(keyframes.base_T_camera[1:][steps])
    seconds = np.maximum(np.diff(keyframes.stamps)[steps], 0.0)
    in_base = to_base @ covariance @ np.swapaxes(to_base, 1, 2)
    near = from_neighbours(in_base.reshape(-1, 36), seconds).reshape(-1, 6, 6)
    size = np.einsum("kii->k", near) / np.einsum("kii->k", in_base)
    near = np.where(((size > 1 / _ALIKE) & (size < _ALIKE))[:, None, None], near, in_base)
    weight = robust[:, None, None] ** 2 * (np.swapaxes(to_base, 1, 2) @ np.linalg.inv(near) @ to_base)
    instruments = sides.copy()
    for k in which:
        own = (to_base @ np.linalg.solve(root, sides[motions, k].reshape(-1, 6, 1)))[..., 0]
        told = np.linalg.solve(to_base, from_neighbours(own, seconds)[..., None])
        instruments[motions, k] = np.linalg.solve(np.swapaxes(root, 1, 2), weight @ told).ravel()
    return instruments


def from_neighbours(motions: Floats, seconds: Floats) -> Floats:
    """Predict motions (n, D) at the rate of the two motions before and the two after each. seconds: (n,) the durations."""

    def near(values: Floats) -> Floats:
        padded = np.pad(values, ((2, 2), (0, 0)))
        return np.asarray(sum(padded[i : i + len(values)] for i in (0, 1, 3, 4)))

    time = near(seconds[:, None])
    return np.asarray(np.where(time > 0, near(motions) / np.maximum(time, 1e-9), 0.0) * seconds[:, None])
