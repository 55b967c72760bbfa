"""Compute the derivatives of the residuals of a graph by the shared errors, for each kind of measurement."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, kind
from objslam.core.geometry import inverse, lengths, log_se3
from objslam.core.types import Keyframes, Rays
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.rays_across import RaysAcross
from objslam.graph.factors.localized_rows import LocalizedRows
from objslam.graph.least_squares.joint_rows import from_origins

_SHORT = 1e-3
"""The step over which a residual is differentiated, as a share of `errors.steps`. With a larger share, the derivative
contains more of the curvature. With a share below 1e-6, it contains rounding errors."""


_Inputs = tuple[Floats | None, ...]
"""The arrays on which the measured values of a kind of measurement depend."""


def parameter_columns(
    of: Linearised, errors: CalibratedMeasurements, theta: Floats
) -> tuple[Floats, dict[int, Bools], RaysAcross]:
    """Return derivatives (M, P) of the whitened residuals by the parameters, and the poses and rays that clocks move.

    The poses are a mask (K,) for each clock, by the index of its parameter. The robust weights are kept fixed. A derivative
    by a clock is a central difference, because velocities change abruptly. The measurements are smooth functions of the
    other parameters, so a difference over a short step (`_SHORT`) is exact enough for them.

    Derivatives of rays are taken where the solution expects the rays, not where they were measured. How much an error
    changes a ray depends on the ray. A lens turns directions in the middle by more than directions at the edge, and a scale
    moves far ranges by more than near ones. At measured rays, the derivatives would contain the noise of the residuals. The
    product of derivatives and residuals would bias the errors (errors in variables; Fuller 1987). On 4,000 frames of a
    simulated rig, the centre of an image was 4 standard deviations off, and an offset of ranges 7.
    """
    joined = of.measured.multiframes
    errors = _at_expected_rays(of, errors, theta)
    result = np.zeros((len(of.rows.residual), len(theta)))
    moved: dict[int, Bools] = {}

    def measured(theta: Floats) -> tuple[Keyframes, Rays, Settings]:
        images, rays, settings = errors.at(theta, drift=False)
        return joined.keyframes(images), joined.rays(images, rays), settings

    images, rays, settings = errors.at(theta, drift=False)
    here = joined.keyframes(images), joined.rays(images, rays), settings
    parts = _parts(of, here[0].base_T_camera, here[1].range)
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
    clocks = {k: errors.cameras.index(errors.names[k].removesuffix(".clock")) for k in moved}
    return result, moved, RaysAcross.of(of, images, rays, clocks)


def _at_expected_rays(of: Linearised, errors: CalibratedMeasurements, theta: Floats) -> CalibratedMeasurements:
    """Return the measurements of the rays in the graph. Directions and ranges are replaced by those that the solution
    expects."""
    images, rays, _ = errors.at(theta, drift=False)
    rays, joined = rays.take(of.which), of.measured.multiframes
    to_landmark = from_origins(joined.rays(images, rays), of.graph.seen(of.map_T_camera, of.positions[of.landmarks]))
    away = lengths(to_landmark)
    turns = joined.first_T_camera(images)[rays.keyframe, :3, :3]
    direction = np.einsum("rji,rj->ri", turns, to_landmark / away[:, None])
    ranges = np.where(np.isfinite(rays.range), away, np.nan)
    return errors.take(errors.keyframes, errors.rays.take(of.which)).with_rays(direction, ranges, theta)


def _same(ours: _Inputs, theirs: _Inputs) -> bool:
    """Return whether two inputs of a part are equal. An array that a parameter does not change is the same object in
    both."""
    pairs = [(one, other) for one, other in zip(ours, theirs, strict=True) if one is not other]
    return all(one is not None and other is not None and np.array_equal(one, other) for one, other in pairs)


@dataclass(frozen=True)
class _Part:
    """The rows of one kind of measurement, from the row `first` on.

    inputs: returns the arrays on which the measured values depend. Parameters that do not change the inputs have the
    derivative 0. Most parameters change the inputs of only one kind of measurement. measured: returns the measured values of
    the rows. residuals: returns the whitened residuals (n, ...) of measured values.
    """

    first: int
    inputs: Callable[[Keyframes, Rays, Settings], _Inputs]
    measured: Callable[[Keyframes, Rays, Settings], tuple[Floats, ...]]
    residuals: Callable[..., Floats]


_Turned = Callable[[Keyframes, Ints | slice], Floats]
"""A function that returns the poses (n, 4, 4) of the cameras of some keyframes, in the frames of the same cameras on their
present mounts."""


def _parts(of: Linearised, mounts: Floats, ranges: Floats) -> tuple[_Part, ...]:
    """Return the kinds of measurements that shared errors may change.

    mounts: (P, 4, 4) the present base_T_camera. ranges: (n,) m, the present ranges of the rays.
    """
    from_mounts = inverse(mounts)

    def turned(keyframes: Keyframes, which: Ints | slice) -> Floats:
        return from_mounts[which] @ keyframes.base_T_camera[which]

    return *_of_rays(of, ranges), _of_motions(of, turned), _of_poses(of, turned), _of_tags(of), _of_localizations(of, turned)


def _off(measured: Floats, solved: Floats, turned: Floats) -> Floats:
    """Return how far solved poses or motions (n, 4, 4) of cameras are from the measured ones, as twists (n, 6).

    The twists are in the frames of the cameras on their present mounts (`turned`: (n, 4, 4)), because the noise belongs to
    the base. Otherwise, a change of the camera's tilt would turn a residual of the heading into a roll of the robot. The
    noise of the roll is far smaller, so the tilt would look known.
    """
    return log_se3(turned @ inverse(measured) @ solved @ inverse(turned))


def _of_rays(of: Linearised, ranges: Floats) -> tuple[_Part, _Part]:
    """Return the bearings and the ranges. ranges: (n,) m, the present ranges of the rays."""
    graph, ranged = of.graph, of.graph.ranged
    seen = graph.seen(of.map_T_camera, of.positions[of.landmarks])
    to_landmark = from_origins(graph.rays, seen)
    axes = graph.bearing_axes(to_landmark)
    bearing_root, _ = graph.bearing_roots(graph.bearing_residuals(graph.rays.direction, to_landmark, axes))
    present = ranges[ranged]
    range_root, _ = graph.range_roots(lengths(to_landmark[ranged]))
    bearings = _Part(
        0,
        lambda _, rays, settings: (rays.direction, rays.offset),
        lambda _, rays, settings: (rays.direction, from_origins(rays, seen)),
        lambda direction, to_landmark: bearing_root * graph.bearing_residuals(direction, to_landmark, axes),
    )
    distances = _Part(
        graph.first_range,
        lambda _, rays, settings: (rays.range[ranged], rays.offset),
        lambda _, rays, settings: (rays.range[ranged], from_origins(rays, seen)[ranged]),
        lambda measured, to_landmark: range_root * (lengths(to_landmark) - measured) / (measured / present),
    )
    return bearings, distances


def _of_motions(of: Linearised, turned: _Turned) -> _Part:
    """Return the motions by the odometry."""
    graph, map_T_camera, (before, after) = of.graph, of.map_T_camera, of.graph.moves
    moved = inverse(map_T_camera[before]) @ map_T_camera[after]
    weight, floor = graph.motion_weights(map_T_camera), of.measured.settings.odometry.floor_xy

    def inputs(keyframes: Keyframes, rays: Rays, settings: Settings) -> _Inputs:
        if not len(before) or keyframes.odom_T_base is None:
            return ()
        return keyframes.odom_T_base, keyframes.base_T_camera, np.array(settings.odometry.floor_xy)

    def measured(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        if not len(before) or keyframes.odom_T_base is None:
            return ()
        odom_T_camera = keyframes.odom_T_base @ keyframes.base_T_camera
        way = np.array(settings.odometry.floor_xy / floor)
        return inverse(odom_T_camera[before]) @ odom_T_camera[after], way, turned(keyframes, after)

    def residuals(motion: Floats, way: Floats, turned: Floats) -> Floats:
        twist = _off(motion, moved, turned) / np.repeat([1.0, float(way)], 3)
        return weight[:, None] * np.einsum("kij,kj->ki", graph.motion_roots, twist)

    return _Part(graph.first_motion, inputs, measured, residuals)


def _of_poses(of: Linearised, turned: _Turned) -> _Part:
    """Return the absolute poses."""
    graph = of.graph
    _, root, _ = graph.absolute_roots(of.map_T_camera)
    some = slice(len(root))  # The keyframes with an absolute pose.
    solved = of.map_T_camera[some]
    return _Part(
        graph.first_motion + 6 * len(graph.moves[0]),
        lambda keyframes, _, settings: (keyframes.map_T_base[some], keyframes.base_T_camera[some]),
        lambda keyframes, _, settings: (
            keyframes.map_T_base[some] @ keyframes.base_T_camera[some],
            turned(keyframes, some),
        ),
        lambda measured, turned: np.einsum("kij,kj->ki", root, _off(measured, solved, turned)),
    )


def _of_tags(of: Linearised) -> _Part:
    """Return the sides of fiducials."""
    (squares, *_), landmarks, tags = of.graph.further, of.positions[of.landmarks], of.measured.tags

    def sides(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        return () if tags is None else (squares.sized(tags.sized(rays.label_names, settings)).side,)

    return _Part(of.graph.first_further, sides, sides, lambda side: squares.by_sides(landmarks, side))


def _of_localizations(of: Linearised, turned: _Turned) -> _Part:
    """Return the motions between localised poses."""
    squares, *others = of.graph.further
    localized = next((one for one in others if isinstance(one, LocalizedRows)), None)

    def measured(keyframes: Keyframes, rays: Rays, settings: Settings) -> tuple[Floats, ...]:
        if localized is None:
            return ()
        poses = keyframes.map_T_camera
        motion = inverse(poses[localized.of.before]) @ poses[localized.of.after]
        return motion, turned(keyframes, localized.of.after)

    def residuals(motion: Floats, turned: Floats) -> Floats:
        assert localized is not None
        twist = _off(motion, localized.moved(of.map_T_camera), turned)
        return np.einsum("kij,kj->ki", localized.weighted_roots(of.map_T_camera), twist)

    return _Part(
        of.graph.first_further + squares.rows_each * len(squares.tag),
        lambda keyframes, _, settings: () if localized is None else (keyframes.map_T_base, keyframes.base_T_camera),
        measured,
        residuals,
    )
