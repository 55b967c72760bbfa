"""The kinds of bodies: upright ellipsoids, cuboids and cylinders, with the same functions for all.

All kinds have seven parameters. These are the centre x, y, z (m), three numbers of the horizontal section, and the logarithm
k of the half axis upwards (m). The first number of the section, p, is the mean logarithm of the horizontal half axes (m).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies import cuboid, cylinder, ellipsoid

PARAMETERS = 7
"""The number of parameters of a body."""


@dataclass(frozen=True)
class Kind:
    """The functions of one kind of bodies.

    support: takes parameters (N, 7), the body (B,) of each box, and unit normals (B, 4, 3). It returns the distances (B, 4),
    m, of tangent planes from the centre, the derivatives (B, 4, 4) of the distances by the last four parameters, and the
    touched points (B, 4, 3), m, relative to the centre.

    sides: takes parameters (B, 1, 7) and the touched points. It returns vectors (B, 4, S, 3), m, from each touched point
    along the S straight sides that end at this point, to their other ends. In a distorted image, a box may touch a side in
    its middle.

    ranges: takes parameters (B, 7), origins (B, 3), m, and unit directions (B, 3) of rays. It returns the distances (B,), m,
    to the surface, their derivatives (B, 7), and a mask (B,) of the rays that hit the surface.

    half_axes: takes parameters (N, 7), and returns the half axes (N, 3), m, the long horizontal one first. heading: takes
    parameters (N, 7), and returns the yaw (N,), rad, of the long horizontal axis. axes_jacobian: takes parameters (N, 7),
    and returns the derivatives (N, 7, 7) of centre, half axes and yaw.
    """

    support: Callable[[Floats, Ints, Floats], tuple[Floats, Floats, Floats]]
    sides: Callable[[Floats, Floats], Floats]
    ranges: Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Bools]]
    half_axes: Callable[[Floats], Floats]
    heading: Callable[[Floats], Floats]
    axes_jacobian: Callable[[Floats], Floats]


def _kind(module: Any) -> Kind:
    return Kind(module.support, module.sides, module.ranges, module.half_axes, module.heading, module.axes_jacobian)


ELLIPSOID, CUBOID, CYLINDER = _kind(ellipsoid), _kind(cuboid), _kind(cylinder)
"""The kinds of bodies. A sphere is an ellipsoid with a tight prior."""
KINDS = (ELLIPSOID, ELLIPSOID, ELLIPSOID, CUBOID, CYLINDER)
"""The kind of each shape, in the order of `core.bodies.body.SHAPES`."""


def rows_of_kinds(shape: Ints) -> list[tuple[Kind, Ints]]:
    """Return each kind that shapes (N,) have, with the indices of its shapes."""
    kind = np.array([KINDS.index(one) for one in KINDS])[shape]
    return [(KINDS[one], np.flatnonzero(kind == one)) for one in np.unique(kind).tolist()]
