"""The linear system of a graph whose parameters are the shared errors. It shows how the joint solution depends on them.

The shared errors are no variables of the graph. Their columns of the Jacobian are differences of the whitened residuals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, kind
from objslam.core.geometry import inverse, lengths, log_se3
from objslam.core.types import Keyframes, Rays
from objslam.graph.calibration.clock_instruments import ClockInstruments
from objslam.graph.calibration.instruments import ODOMETRY_SCALES, Motions, motion_instruments
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.factors.localized_rows import LocalizedRows
from objslam.graph.least_squares.chain import ChainRows
from objslam.graph.least_squares.joint_rows import from_origins
from objslam.graph.least_squares.normal_equations import Equations

_SHORT = 1e-3
"""The step of a derivative, as a share of `errors.steps`. With a larger share, the derivative contains more of the
curvature. With a share below 1e-6, it contains rounding errors."""


_Inputs = tuple[Floats | None, ...]
"""What the measured values of a kind of measurement depend on."""


@dataclass(frozen=True)
class LinearSystem:
    """The whitened Jacobian and residuals of a graph and its shared errors. The robust weights are kept fixed.

    The rows are in the order of `Measurements.factors`: bearings, ranges, landmark priors, motions, absolute poses. The
    corners of fiducials are last. jacobian: (M, D) by the landmarks, three columns each, then by the poses, six columns
    each. normal: the normal equations of the Jacobian. chain: as in `JointRows`. sides: (M, P) the derivatives of the rows
    by the shared errors. residual: (M,). first_range, first_motion: the first rows of the ranges and of the motions.
    instruments: (M, P). At the optimum, the residuals do not correlate with the instruments. The instruments equal the
    sides, except for clocks and the scales of the odometry: these sides contain the noise of the odometry, and so do the
    residuals. motions: None if neither the odometry nor a clock is a parameter. clocks: None without a clock. by_path: (M,
    C) instruments of the C clocks by the solved path. noise: (P, P) from `noise_shares`, the shares of noise in the
    information. longer: (P,) the ratio of the odometry's noise in the residuals to that in the side of a scale, 0 for other
    parameters.
    """

    jacobian: sparse.csr_matrix
    sides: Floats
    instruments: Floats
    residual: Floats
    first_range: int
    first_motion: int
    normal: Equations
    chain: ChainRows | None
    motions: Motions | None
    clocks: ClockInstruments | None
    by_path: Floats
    noise: Floats
    longer: Floats

    def with_noise(self, noise: Floats) -> Self:
        """Return the system for these shares (P, P) of noise in its sides. They change the instruments of clocks."""
        instruments, columns = self.instruments.copy(), [] if self.clocks is None else list(self.clocks.moved)
        sides = self.sides[:, columns]
        instruments[:, columns] = sides + (self.by_path - sides) @ noise[np.ix_(columns, columns)]
        return replace(self, instruments=instruments, noise=noise)

    def left(self, columns: Floats) -> Floats:
        """Return the residuals of columns (M, n) after a least-squares fit by poses and landmarks."""
        return columns - self.jacobian @ self.normal.solve(self.jacobian.T @ columns)

    def reduce(self) -> "ReducedSystem":
        """Eliminate poses and landmarks by a Schur complement, and remove the expected products of noise."""
        own = np.flatnonzero((self.instruments != self.sides).any(axis=0))
        columns = np.column_stack([self.sides, self.residual, self.instruments[:, own]])
        changes = -self.normal.solve(self.jacobian.T @ columns)
        left = columns + self.jacobian @ changes
        count = self.sides.shape[1]
        sides, residual, instruments = left[:, :count], left[:, count], left[:, :count].copy()
        instruments[:, own] = left[:, count + 1 :]
        information, variance, slope = sides.T @ sides, instruments.T @ instruments, instruments.T @ sides
        noise = np.diag(np.diagonal(self.noise) * np.diagonal(information))
        gradient = -instruments.T @ residual + np.diagonal(noise) * self.longer
        if self.clocks is not None:
            moved = np.array(list(self.clocks.moved))
            others, block = np.setdiff1d(np.arange(count), moved), np.ix_(moved, moved)
            shares = self.noise[block]
            poses = len(self.clocks.seconds)
            velocity = self.clocks.changes(changes[-6 * poses :, :count].reshape(poses, 6, count))
            # The side of a clock can be mostly noise. In products with other instruments, its instrument replaces it.
            slope[others[:, None], moved] = variance[others[:, None], moved]
            # The path, and with it the instrument, depends on the parameters too. Without this part, the noise that the path
            # and the side have in common would be in the slope.
            slope[moved] += shares.T @ [self.clocks.products(residual, k, velocity) for k in moved]
            noise[block] = (np.eye(len(moved)) - shares).T @ information[block] @ shares
        return ReducedSystem(
            information=information,
            slope=slope - noise,
            variance=variance,
            gradient=gradient,
            descent=-sides.T @ residual,
            sensitivity=changes[:, :count],
            newton=changes[:, count],
        )


@dataclass(frozen=True)
class ReducedSystem:
    """The normal equations of the parameters with poses and landmarks eliminated.

    information: (P, P) the curvature of the cost. descent: (P,) the negative gradient of the cost. gradient: (P,) minus the
    products of the instruments and the residuals, zero at the optimum. slope: (P, P) the decrease of the gradient by each
    parameter. variance: (P, P) of the gradient by white noise. The gradient and the slope have no expected noise.
    sensitivity: (D, P) the derivatives of all variables at their optimum by the parameters: first the landmarks, three rows
    each, then the poses, six rows each. newton: (D,) the remaining Newton step of the variables.
    """

    information: Floats
    slope: Floats
    variance: Floats
    gradient: Floats
    descent: Floats
    sensitivity: Floats
    newton: Floats

    def take(self, parameters: Ints) -> Self:
        """Return the system of some parameters (n,) alone."""
        block = np.ix_(parameters, parameters)
        return replace(
            self,
            information=self.information[block],
            slope=self.slope[block],
            variance=self.variance[block],
            gradient=self.gradient[parameters],
            descent=self.descent[parameters],
            sensitivity=self.sensitivity[:, parameters],
        )

    def with_wider(self, factors: Floats | None) -> Self:
        """Return the system with larger standard deviations of its gradient. factors: (P,), None leaves them as they are."""
        return self if factors is None else replace(self, variance=self.variance * np.outer(factors, factors))


def linearise(of: Linearised, errors: CalibratedMeasurements, theta: Floats, noise: Floats | None = None) -> LinearSystem:
    """Return the linear system of a graph at its values and at the shared errors theta (P,).

    noise: (P, P) from `noise_shares`. None means that the sides have no noise. SolveError if the system is singular.
    """
    graph, rows = of.graph, of.rows
    sides, moved = _parameter_columns(of, errors, theta)
    asked = bool(moved) or any(name.startswith("odometry.") for name in errors.names)
    motions = Motions.of(of) if asked and len(graph.motion_roots) else None
    clocks = ClockInstruments.of(of, moved, motions) if moved else None
    by_path = sides[:, list(moved)]
    for i, k in enumerate(moved):
        assert clocks is not None
        clocks.put(by_path[:, i : i + 1], k, clocks.velocity[..., None])
    found = LinearSystem(
        jacobian=rows.jacobian,
        sides=sides,
        instruments=motion_instruments(motions, errors.names, sides),
        residual=rows.residual,
        first_range=graph.first_range,
        first_motion=graph.first_motion,
        normal=of.normal,
        chain=rows.chain,
        motions=motions,
        clocks=clocks,
        by_path=by_path,
        noise=np.zeros((len(theta), len(theta))),
        longer=np.where([name in ODOMETRY_SCALES for name in errors.names], 1 + theta, 0.0),
    )
    return found if noise is None else found.with_noise(noise)


def _parameter_columns(of: Linearised, errors: CalibratedMeasurements, theta: Floats) -> tuple[Floats, dict[int, Bools]]:
    """Return derivatives (M, P) of the whitened residuals by the parameters, and the poses (K,) that each clock moves.

    The robust weights are kept fixed. A derivative by a clock is a central difference, because velocities change abruptly.
    The measurements are smooth functions of the other parameters. So a difference over a short step (`_SHORT`) is exact
    enough there.
    """
    joined = of.measured.multiframes
    result = np.zeros((len(of.rows.residual), len(theta)))
    moved: dict[int, Bools] = {}

    def measured(theta: Floats) -> tuple[Keyframes, Rays, Settings]:
        images, rays, settings = errors.at(theta, drift=False)
        return joined.keyframes(images), joined.rays(images, rays.take(of.which)), settings

    here = measured(theta)
    parts = _parts(of, here[0].base_T_camera, here[1].sigma)
    inputs, values = [part.inputs(*here) for part in parts], [part.measured(*here) for part in parts]
    residuals = [part.residuals(*value) if value else np.zeros(0) for part, value in zip(parts, values, strict=True)]
    for k, name in enumerate(errors.names):
        clock = kind(name) == "clock"
        step = errors.steps[k] * (1.0 if clock else _SHORT)
        change = step * np.eye(len(theta))[k]
        ahead, behind = measured(theta + change), measured(theta - change) if clock else None
        if clock:
            moved[k] = np.abs(ahead[0].stamps - here[0].stamps) > step / 2  # At the ends of the path, stamps hardly move.
        for part, given, residual in zip(parts, inputs, residuals, strict=True):
            if not _same(part.inputs(*ahead), given if behind is None else part.inputs(*behind)):
                before = residual if behind is None else part.residuals(*part.measured(*behind))
                off = (part.residuals(*part.measured(*ahead)) - before).ravel()
                result[part.first : part.first + len(off), k] = off / (2 * step if clock else step)
    return result, moved


def _same(ours: _Inputs, theirs: _Inputs) -> bool:
    """Return whether inputs of a part are equal. The parameters that do not change an array share it."""
    pairs = [(one, other) for one, other in zip(ours, theirs, strict=True) if one is not other]
    return all(one is not None and other is not None and np.array_equal(one, other) for one, other in pairs)


@dataclass(frozen=True)
class _Part:
    """The rows of one kind of measurement, from the row `first` on.

    inputs: returns what the measured values depend on. Parameters that do not change the inputs have no derivative here, and
    most parameters change those of one kind of measurement. measured: returns the measured values of these rows. residuals:
    returns the whitened residuals of measured values.
    """

    first: int
    inputs: Callable[[Keyframes, Rays, Settings], _Inputs]
    measured: Callable[[Keyframes, Rays, Settings], tuple[Floats, ...]]
    residuals: Callable[..., Floats]


def _parts(of: Linearised, mounts: Floats, usual: Floats) -> tuple[_Part, ...]:
    """Return the kinds of measurements that shared errors may change.

    mounts: (P, 4, 4) the present base_T_camera. usual: (n,) rad, the present sigmas of the rays.
    """
    graph, map_T_camera = of.graph, of.map_T_camera
    (before, after), ranged = graph.moves, graph.ranged
    seen = graph.seen(map_T_camera, of.positions[of.landmarks])
    to_landmark = from_origins(graph.rays, seen)
    axes = graph.bearing_axes(to_landmark)
    bearing_root, _ = graph.bearing_roots(graph.bearing_residuals(graph.rays.direction, to_landmark, axes))
    range_ = graph.rays.range[ranged]
    range_root, _ = graph.range_roots(lengths(to_landmark[ranged]))
    moved = inverse(map_T_camera[before]) @ map_T_camera[after]
    motion_weight = graph.motion_weights(map_T_camera)
    floor = of.measured.settings.odometry.floor_xy
    _, absolute_root, _ = graph.absolute_roots(map_T_camera)
    some = slice(len(absolute_root))  # The keyframes with an absolute pose.
    absolute = map_T_camera[some]

    def bearings(direction: Floats, sigma: Floats, to_landmark: Floats) -> Floats:
        # The lens changes angles between directions, and the noise of directions as well (`SharedErrors.at`). Without the
        # noise, every log would ask for a longer focal length.
        return bearing_root * graph.bearing_residuals(direction, to_landmark, axes) * (usual / sigma)[:, None]

    def distances(measured: Floats, to_landmark: Floats) -> Floats:
        return np.asarray(range_root * (lengths(to_landmark) - measured) / (measured / range_))

    from_mounts = inverse(mounts)

    def turned(keyframes: Keyframes, which: Ints | slice) -> Floats:
        """Return the poses (n, 4, 4) of the cameras of some keyframes on their mounts, in the frames of the cameras on the
        present mounts."""
        return from_mounts[which] @ keyframes.base_T_camera[which]

    def off(measured: Floats, moved: Floats, turned: Floats) -> Floats:
        # The noise belongs to base. It turns with the camera, or a residual of the heading would make the tilt of the camera
        # look known: turned by this tilt, it would become a roll of the robot, whose noise is far smaller.
        return log_se3(turned @ inverse(measured) @ moved @ inverse(turned))

    def told(keyframes: Keyframes, rays: Rays, settings: Settings) -> _Inputs:
        if not len(before) or keyframes.odom_T_base is None:
            return ()
        return keyframes.odom_T_base, keyframes.base_T_camera, np.array(settings.odometry.floor_xy)

    def said(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        if not len(before) or keyframes.odom_T_base is None:
            return ()
        odom_T_camera = keyframes.odom_T_base @ keyframes.base_T_camera
        way = np.array(settings.odometry.floor_xy / floor)
        return inverse(odom_T_camera[before]) @ odom_T_camera[after], way, turned(keyframes, after)

    def motions(motion: Floats, way: Floats, turned: Floats) -> Floats:
        twist = off(motion, moved, turned) / np.repeat([1.0, float(way)], 3)
        return motion_weight[:, None] * np.einsum("kij,kj->ki", graph.motion_roots, twist)

    def poses(measured: Floats, turned: Floats) -> Floats:
        return np.einsum("kij,kj->ki", absolute_root, off(measured, absolute, turned))

    (squares, *others), landmarks = graph.further, of.positions[of.landmarks]

    def sides(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        tags = of.measured.tags
        return () if tags is None else (squares.sized(tags.sized(rays.label_names, settings)).side,)

    localized = next((one for one in others if isinstance(one, LocalizedRows)), None)

    def between(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        if localized is None:
            return ()
        poses = keyframes.map_T_camera
        motion = inverse(poses[localized.of.before]) @ poses[localized.of.after]
        return motion, turned(keyframes, localized.of.after)

    def localized_motions(motion: Floats, turned: Floats) -> Floats:
        assert localized is not None
        twist = off(motion, localized.moved(map_T_camera), turned)
        return np.einsum("kij,kj->ki", localized.weighted_roots(map_T_camera), twist)

    return (
        _Part(
            0,
            lambda _, rays, settings: (rays.direction, rays.sigma, rays.offset),
            lambda _, rays, settings: (rays.direction, rays.sigma, from_origins(rays, seen)),
            bearings,
        ),
        _Part(
            graph.first_range,
            lambda _, rays, settings: (rays.range[ranged], rays.offset),
            lambda _, rays, settings: (rays.range[ranged], from_origins(rays, seen)[ranged]),
            distances,
        ),
        _Part(graph.first_motion, told, said, motions),
        _Part(
            graph.first_motion + 6 * len(before),
            lambda keyframes, _, settings: (keyframes.map_T_base[some], keyframes.base_T_camera[some]),
            lambda keyframes, _, settings: (
                keyframes.map_T_base[some] @ keyframes.base_T_camera[some],
                turned(keyframes, some),
            ),
            poses,
        ),
        _Part(graph.first_further, sides, sides, lambda side: squares.by_sides(landmarks, side)),
        _Part(
            graph.first_further + squares.rows_each * len(squares.tag),
            lambda keyframes, _, settings: () if localized is None else (keyframes.map_T_base, keyframes.base_T_camera),
            between,
            localized_motions,
        ),
    )
