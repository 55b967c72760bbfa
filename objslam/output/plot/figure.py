"""The content of a picture of a map: lines, marks, areas and labels, in metres. The module `page` draws a figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats

Colour = tuple[float, float, float]
"""Red, green and blue in [0, 1]."""


@dataclass(frozen=True)
class Segments:
    """Thin segments with the ends (n, 2, 2), m. Overlapping segments are darker. opacity: the opacity of one segment, in
    [0, 1]. name: the name in the legend, "" for no entry."""

    ends: Floats
    colour: Colour
    opacity: float
    name: str


@dataclass(frozen=True)
class Line:
    """A line through points (n, 2), m. width: px. name: the name in the legend, "" for no entry."""

    points: Floats
    colour: Colour
    width: float
    name: str = ""
    dashed: bool = False


@dataclass(frozen=True)
class Marks:
    """Marks of one size (px) at points (n, 2), m. A cross has thin arms, a plus has thick arms, and an x is a turned plus.
    rim: the colour of the rim of a dot. name: the name in the legend, "" for no entry. turn: the direction of a triangle,
    rad counterclockwise from the right."""

    points: Floats
    kind: Literal["dot", "cross", "plus", "x", "diamond", "triangle"]
    colour: Colour
    rim: Colour
    size: float
    name: str = ""
    turn: float = 0.0


@dataclass(frozen=True)
class Area:
    """A filled polygon. rim: its corners (n, 2), m. opacity: the opacity of the filling, in [0, 1]."""

    rim: Floats
    colour: Colour
    opacity: float


@dataclass(frozen=True)
class Label:
    """A text in a box. box: (4,) x1, y1, x2, y2, px of the shown area. leader: (2, 2) ends of a line from the dot to the
    text, px of the shown area, None for no line."""

    text: str
    colour: Colour
    box: Floats
    leader: Floats | None = None


Shape = Segments | Line | Marks | Area


@dataclass(frozen=True)
class Figure:
    """A picture of a map from above.

    axes: the names of the axes to the right and up. low, high: (2,) corners of the shown area, m. scale: px/m. shapes: the
    drawn shapes, in the order of drawing. legend: entries of the legend for which no shape has a name. note: a remark at the
    upper right. warning: a text under the title with the reason why the map should not be trusted.
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
