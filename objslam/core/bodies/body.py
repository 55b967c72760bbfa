"""The body of an object: its shape, its size and its heading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from objslam.core.arrays import Floats

Shape = Literal["point", "sphere", "ellipsoid", "cuboid", "cylinder"]
SHAPES: tuple[Shape, ...] = ("point", "sphere", "ellipsoid", "cuboid", "cylinder")
"""The shapes of objects. A point has no size."""
UNKNOWN_YAW = float(np.pi / np.sqrt(12))
"""The standard deviation (rad) of a yaw about which nothing is known: the standard deviation of a uniform distribution over
half a turn."""


@dataclass(frozen=True)
class Body:
    """An upright body around the position of its object.

    shape: `cuboid`, `cylinder`, `ellipsoid` or `sphere`. A cylinder may have an elliptic section. The shape is `sphere` if
    an ellipsoid does not fit the boxes better. size: (3,) m, the full length, width and height. The length is the longer
    horizontal side. yaw: rad in (-pi/2, pi/2], the direction of the length in the plane seen from above. size_sigma: (3,) m,
    the standard deviations of the size. yaw_sigma: rad, the standard deviation of the yaw. Its largest value, `UNKNOWN_YAW`,
    means that the yaw is unknown.
    """

    shape: Shape
    size: Floats
    yaw: float
    size_sigma: Floats
    yaw_sigma: float


def turned(body: Body, rotation: Floats) -> Body:
    """Return a body after a rotation (3, 3) about an upright axis."""
    x, y, _ = rotation @ np.array([np.cos(body.yaw), np.sin(body.yaw), 0.0])
    return replace(body, yaw=float(np.pi / 2 - (np.pi / 2 - np.arctan2(y, x)) % np.pi))


@dataclass(frozen=True)
class PlacedBody:
    """A body in a map. centre: (3,) m, None if the position from the object's rays is as good or better. covariance: (7, 7)
    of the centre, the size and the yaw, in m and rad. behind: whether other things hide parts of the body in many of its
    boxes. If so, the object's position is this centre."""

    body: Body
    centre: Floats | None
    covariance: Floats
    behind: bool = False

    def with_errors(self, more: Floats) -> Self:
        """Return the body with the covariance (3, 3), m^2, that errors add to its centre."""
        covariance = self.covariance.copy()
        covariance[:3, :3] += more
        return replace(self, covariance=covariance)


def surer_body(a: Body | None, b: Body | None) -> Body | None:
    """Return the body with the more certain size, or the only body, or None."""
    if a is None or b is None:
        return a or b
    return b if b.size_sigma.prod() < a.size_sigma.prod() else a
