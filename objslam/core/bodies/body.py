"""The body of an object: its shape, its size and its heading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from objslam.core.arrays import Floats

Shape = Literal["point", "sphere", "ellipsoid", "cuboid"]
SHAPES: tuple[Shape, ...] = ("point", "sphere", "ellipsoid", "cuboid")
"""The shapes of objects. A point has no size."""


@dataclass(frozen=True)
class Body:
    """An upright body around the position of its object.

    shape: `cuboid`, `ellipsoid`, or `sphere` if its boxes do not tell an ellipsoid from a sphere. size: (3,) m, the full
    length, width and height. The length is the longer horizontal side. yaw: rad in (-pi/2, pi/2], the direction of the
    length in the plane seen from above. size_sigma: (3,) m. yaw_sigma: rad, at most that of an unknown direction (0.91).
    """

    shape: Shape
    size: Floats
    yaw: float
    size_sigma: Floats
    yaw_sigma: float


@dataclass(frozen=True)
class PlacedBody:
    """A body in a map. centre: (3,) m. covariance: (7, 7) of the centre, the size and the yaw."""

    body: Body
    centre: Floats
    covariance: Floats
