"""Texts beside the points of a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Floats
from objslam.output.plot.canvas import text_width
from objslam.output.plot.figure import Colour, Figure, Label
from objslam.output.plot.label_layout import needs_leader, place_labels
from objslam.output.plot.page import FONT, LINE

_STEP = (
    2.0  # The distance, px, between the points of an outline that labels avoid. A larger one lets labels cover more of it.
)
_MAX_LETTERS = 28  # The largest number of letters of a label. An ellipsis replaces the rest.


def make_labels(
    figure: Figure, names: Sequence[str], colours: Sequence[Colour], points: Floats, avoid: Floats
) -> tuple[Label, ...]:
    """Return a label beside each point (N, 2), m. A name without a free place has no label.

    names: N texts. avoid: (P, 2) points that labels should not cover, px of the shown area.
    """
    sizes = np.array([(text_width(text, FONT), LINE * FONT) for text in names]).reshape(-1, 2)
    anchors = figure.pixels(points) if len(points) else np.zeros((0, 2))
    corners, found = place_labels(anchors, sizes, np.array([[0, 0], figure.size], dtype=np.float64), avoid)
    led = needs_leader(anchors, corners, sizes)
    labels = []
    for i in np.flatnonzero(found).tolist():
        near = np.clip(anchors[i], corners[i], corners[i] + sizes[i])
        leader = np.stack([anchors[i], near]) if led[i] else None
        labels.append(Label(names[i], colours[i], np.concatenate([corners[i], corners[i] + sizes[i]]), leader))
    return tuple(labels)


def drawn_points(rim: Floats) -> Floats:
    """Return points (P, 2), px, along an outline (n, 2), px, at most about `_STEP` px apart. No label fits between them.

    The outline of a cuboid has only its corners, and a label would fit between two corners.
    """
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(rim, axis=0), axis=1)))
    at = np.linspace(0.0, way[-1], max(int(way[-1] / _STEP), 1) + 1)
    return np.column_stack([np.interp(at, way, rim[:, axis]) for axis in (0, 1)])


def shortened(name: str) -> str:
    """Return a name as one line of at most `_MAX_LETTERS` letters."""
    name = " ".join(name.split())
    return name if len(name) <= _MAX_LETTERS else name[: _MAX_LETTERS - 1] + "…"
