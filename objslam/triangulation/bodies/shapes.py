"""The kinds of bodies: upright ellipsoids, cuboids and cylinders, with the same functions for all.

All have seven parameters: the centre x, y, z (m), a number p and two numbers of the horizontal section, and the logarithm k
of the half axis upwards. p is the mean logarithm of the horizontal half axes. `support` returns how far tangent planes are
from the centre, `ranges` how far the surface is along rays.
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
    """One kind of bodies.

    support: takes parameters (N, 7), the body (B,) of each box, and unit normals (B, 4, 3). Returns the distances (B, 4), m,
    of tangent planes from the centre, their derivatives (B, 4, 4) by the last four parameters, and the points (B, 4, 3), m,
    that they touch, relative to the centre.
    sides: takes parameters (B, 1, 7) and those points. Returns vectors (B, 4, S, 3), m, along the straight sides of the body
    that end there, to their other ends. In a distorted image, a box may touch a side in its middle.
    ranges: takes parameters (B, 7), origins (B, 3), m, and directions (B, 3) of rays. Returns the distances (B,), m, to the
    surface, their derivatives (B, 7), and which rays (B,) hit it. The other functions take parameters (N, 7). half_axes:
    returns the half axes (N, 3), m, the long horizontal one first. heading: the yaw (N,), rad, of the long axis.
    axes_jacobian: the derivatives (N, 7, 7) of centre, half axes and yaw by the parameters.
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
