"""Pictures of the life of objects, from above: what is still there, what moved, what is gone, and what is new."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject, ObjectMap
from objslam.errors import printable
from objslam.mapping.sites.compare import Comparison
from objslam.output.plot.label_layout import place_labels
from objslam.output.plot.style import frame_objects

_COLOURS = {"confirmed": "#4b5563", "unseen": "#767676", "new": "#1a7f37", "moved": "#0b63c5", "gone": "#c22f2f"}
"""The colour of each outcome."""
_MARKERS = {"confirmed": "o", "unseen": "o", "new": "P", "moved": "D", "gone": "X"}
"""The marker of each outcome, so that the picture is readable without colours."""
_LONG_SIDE, _SHORT_SIDE = 8.0, 4.0
"""The length of the map's longer side, and the least length of the other side, inches. Larger values make a larger
picture."""
_FONT = 8.0
"""The font size of labels and legend, points. A larger size has room for fewer labels."""
_LETTERS = 24
"""The most letters of a label. A larger number cuts fewer labels."""


def draw_site(objects: ObjectMap) -> bytes:
    """Return a PNG of the map of a site, with what became of each object."""
    items = [(_outcome(o), o) for o in (*objects.objects, *objects.gone)]
    return _draw(items, f"{len(objects)} objects")


def draw_comparison(found: Comparison) -> bytes:
    """Return a PNG of the comparison of two maps, in the frame of the first."""
    return _draw([(one.outcome, one.item) for one in found.changes], "changes since the first map")


def _outcome(o: MapObject) -> str:
    return "confirmed" if o.life is None else o.life.state


def _draw(items: Sequence[tuple[str, MapObject]], title: str) -> bytes:
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # The user's own style may use TeX or white text.
        return _draw_figure(items, title)


def _draw_figure(items: Sequence[tuple[str, MapObject]], title: str) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    everything = np.array([o.position[:2] for _, o in items]).reshape(-1, 2)
    inside, low, high = frame_objects(everything, np.zeros((0, 2)))
    items = [item for item, there in zip(items, inside, strict=True) if there]
    points, before = everything[inside], np.array([_before(o)[:2] for _, o in items]).reshape(-1, 2)
    title += f", {int((~inside).sum())} far away not shown" if not inside.all() else ""
    margin = 0.08 * max(float((high - low).max()), 1.0)
    low, high = np.minimum(low, before.min(axis=0, initial=np.inf)), np.maximum(high, before.max(axis=0, initial=-np.inf))
    low, high = low - margin, high + margin
    width, height = (high - low) / (high - low).max() * _LONG_SIDE
    size = max(width, _SHORT_SIDE) + 0.6, max(height, _SHORT_SIDE) + 1.2  # The added inches are for title and legend.
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    axes.grid(True, color="#ececec", linewidth=0.6)
    axes.set_axisbelow(True)
    for outcome, colour in _COLOURS.items():
        mine = np.array([one == outcome for one, _ in items], dtype=bool)
        if not mine.any():
            continue
        if outcome == "moved":
            for start, end in zip(before[mine], points[mine], strict=True):
                axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.2})
        name = f"{outcome} ({int(mine.sum())})"
        face = "white" if outcome == "unseen" else colour
        marks: dict[str, Any] = {"markersize": 6, "markerfacecolor": face, "linestyle": "", "zorder": 3}
        axes.plot(*points[mine].T, _MARKERS[outcome], color=colour, label=name, **marks)
    axes.set_title(title, fontsize=10, loc="left")
    if items:
        figure.legend(loc="outside lower left", ncols=5, fontsize=_FONT, frameon=False)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # Labels are placed by pixels, so the layout is frozen.
    _draw_labels(axes, canvas.get_renderer(), items, points)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _before(o: MapObject) -> Floats:
    return o.position if o.life is None or o.life.moved_from is None else o.life.moved_from


def _draw_labels(axes: Any, renderer: Any, items: Sequence[tuple[str, MapObject]], points: Floats) -> None:
    """Write the label of each object beside it, where there is room. Objects that changed come first."""
    order = sorted(range(len(items)), key=lambda k: items[k][0] in ("confirmed", "unseen"))
    texts = []
    for k in order:
        outcome, o = items[k]
        name = printable(f"{o.label} #{o.id}")
        short = name if len(name) <= _LETTERS else name[: _LETTERS - 1] + "\u2026"
        texts.append(axes.text(0, 0, short, fontsize=_FONT, color=_COLOURS[outcome], va="bottom", ha="left", zorder=4))
    boxes = [text.get_window_extent(renderer) for text in texts]
    sizes = np.array([(box.width, box.height) for box in boxes]).reshape(-1, 2)
    anchors = axes.transData.transform(points[order]).reshape(-1, 2)
    frame = axes.get_window_extent(renderer)
    area = np.array([[frame.x0, frame.y0], [frame.x1, frame.y1]])
    corners, placed = place_labels(anchors, sizes, area, np.zeros((0, 2)))
    back = axes.transData.inverted().transform(corners).reshape(-1, 2)
    for text, corner, there in zip(texts, back, placed, strict=True):
        text.set_position(corner) if there else text.remove()
