"""What a picture of a map shows: lines, marks, areas and labels, in metres. `page` draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats

Colour = tuple[float, float, float]
"""Red, green and blue in [0, 1]."""


@dataclass(frozen=True)
class Segments:
    """Thin segments (n, 2, 2), m. The more of them overlap, the darker they are. opacity: of one segment, in [0, 1]. name:
    in the legend, "" for no entry."""

    ends: Floats
    colour: Colour
    opacity: float
    name: str


@dataclass(frozen=True)
class Line:
    """A line through points (n, 2), m. width: px. name: in the legend, "" for no entry."""

    points: Floats
    colour: Colour
    width: float
    name: str = ""
    dashed: bool = False


@dataclass(frozen=True)
class Marks:
    """Marks of one size (px) at points (n, 2), m. A cross is thin, a plus has thick arms, and an x is a plus that is turned.
    rim: the colour of the rim of a dot. name: in the legend, "" for no entry. turn: of a triangle, rad counterclockwise from
    the right."""

    points: Floats
    kind: Literal["dot", "cross", "plus", "x", "diamond", "triangle"]
    colour: Colour
    rim: Colour
    size: float
    name: str = ""
    turn: float = 0.0


@dataclass(frozen=True)
class Area:
    """A filled area inside the points (n, 2), m, with a rim. opacity: of the filling, in [0, 1]."""

    rim: Floats
    colour: Colour
    opacity: float


@dataclass(frozen=True)
class Label:
    """A text in the box (4,) x1, y1, x2, y2, px of the map's area. leader: (2, 2) px, a line to its dot, or None."""

    text: str
    colour: Colour
    box: Floats
    leader: Floats | None = None


Shape = Segments | Line | Marks | Area


@dataclass(frozen=True)
class Figure:
    """A picture of a map from above.

    axes: the names of the axes to the right and up. low, high: (2,) m, the corners of the shown area. scale: px/m. shapes:
    what is drawn, the lowest first. legend: more entries. Each shape with a name has one anyway. note: a remark at the upper
    right. warning: why the map should not be trusted, under the title.
    """

    title: str
    axes: tuple[str, str]
    low: Floats
    high: Floats
    scale: float
    shapes: tuple[Shape, ...]
    legend: tuple[Line | Marks, ...] = ()
    labels: tuple[Label, ...] = ()
    note: str = ""
    warning: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the shown area, px."""
        width, height = np.ceil((self.high - self.low) * self.scale).astype(int).tolist()
        return width, height

    def pixels(self, points: Floats) -> Floats:
        """Return points (..., 2), m, in px of the shown area: x to the right, y down."""
        return np.asarray((points - [self.low[0], self.high[1]]) * [self.scale, -self.scale])
