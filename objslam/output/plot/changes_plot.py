"""Draw pictures from above of objects that are confirmed, moved, gone or new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import Fate, MapObject, ObjectMap
from objslam.errors import printable
from objslam.mapping.sites.compare import Change, Comparison
from objslam.output.plot.figure import Colour, Figure, Label, Line, Marks, Shape
from objslam.output.plot.labels import drawn_points, make_labels, shortened
from objslam.output.plot.page import render
from objslam.output.plot.style import body_outline, frame_objects

_LONG_SIDE, _SHORT_SIDE = 1200.0, 600.0
"""The longer side of the map has the length `_LONG_SIDE` (px), and the other side has at least `_SHORT_SIDE` (px). Larger
values make a larger picture."""
_MARGIN = 0.08
"""The margin around the objects, as a share of the longer side. A larger share leaves more room for labels at the edge."""
_MARK, _ARROW = 15.0, 18.0
"""The size of the mark of an object, and of the head of an arrow, px."""
_LINE = 2.0
"""The width, px, of the arrow of an object that moved, and of the outline of a body."""
_WHITE: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class _Look:
    """The look of the marks of an outcome. Outcomes differ in colour and in the kind of mark, so that a picture without
    colours can be read. words: the text after the name in the legend."""

    colour: Colour
    kind: Literal["dot", "plus", "x", "diamond"]
    hollow: bool = False
    words: str = ""


_LOOKS: dict[str, _Look] = {
    "confirmed": _Look((0.294, 0.333, 0.388), "dot"),
    "unconfirmed": _Look((0.463, 0.463, 0.463), "dot", hollow=True, words=": only one had it in view"),
    "new": _Look((0.102, 0.498, 0.216), "plus"),
    "moved": _Look((0.043, 0.388, 0.773), "diamond"),
    "gone": _Look((0.761, 0.184, 0.184), "x"),
}
"""The look of the marks of each outcome."""


def draw_site(objects: ObjectMap) -> bytes:
    """Return a PNG file of the map of a site, with the outcome of each object."""
    items = [(outcome_of(o), o) for o in (*objects.objects, *objects.gone)]
    return render(changes_figure(items, f"{len(objects)} objects"))


def draw_comparison(found: Comparison) -> bytes:
    """Return a PNG file of the comparison of two maps, in the frame of the first map."""
    items = [(one.outcome, one.item) for one in found.changes]
    names = [_named(one) for one in found.changes]
    return render(changes_figure(items, "changes since the first map (A, the later one is B)", names))


def _named(one: Change) -> str:
    """Return the name of an object with its id in both maps, such as "cup A5 B14"."""
    ids = [f"{name}{number}" for name, number in (("A", one.id_a), ("B", one.id_b)) if number is not None]
    return " ".join([one.item.label, *ids])


def changes_figure(items: Sequence[tuple[str, MapObject]], title: str, names: Sequence[str] | None = None) -> Figure:
    """Return the figure of objects with their outcomes. names: the texts of the labels. The default is label and id."""
    if names is None:
        names = [f"{o.label} #{o.id}" for _, o in items]
    everything = np.array([o.position[:2] for _, o in items]).reshape(-1, 2)
    inside, low, high = frame_objects(everything, np.zeros((0, 2)))
    items = [item for item, there in zip(items, inside, strict=True) if there]
    names = [shortened(printable(name)) for name, there in zip(names, inside, strict=True) if there]
    points, before = everything[inside], np.array([_before(o)[:2] for _, o in items]).reshape(-1, 2)
    title += f", {int((~inside).sum())} far away not shown" if not inside.all() else ""
    low, high = np.minimum(low, before.min(axis=0, initial=np.inf)), np.maximum(high, before.max(axis=0, initial=-np.inf))
    margin = _MARGIN * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    scale = _LONG_SIDE / float((high - low).max())
    wider = np.maximum(_SHORT_SIDE / scale - (high - low), 0.0) / 2
    shapes: list[Shape] = []
    marks: list[Shape] = []
    for outcome, look in _LOOKS.items():
        mine = np.array([one == outcome for one, _ in items], dtype=bool)
        if not mine.any():
            continue
        shapes += _outlines([o for one, o in items if one == outcome], look.colour, (_MARK + 2 * _LINE) / scale)
        if outcome == "moved":
            shapes += _arrows(before[mine], points[mine], look.colour)
        face, rim = (_WHITE, look.colour) if look.hollow else (look.colour, _WHITE)
        marks.append(Marks(points[mine], look.kind, face, rim, _MARK, f"{outcome} ({int(mine.sum())}){look.words}"))
    figure = Figure(title, ("x", "y"), low - wider, high + wider, scale, (*shapes, *marks))
    return replace(figure, labels=_labels(figure, items, points, names))


def outcome_of(o: MapObject) -> Fate:
    """Return the outcome of an object of a site, such as "moved" or "gone"."""
    return "confirmed" if o.life is None else o.life.state


def outcome_colour(outcome: Fate) -> Colour:
    """Return the colour of an outcome in all pictures and pages of a site."""
    return _LOOKS[outcome].colour


def _before(o: MapObject) -> Floats:
    return o.position if o.life is None or o.life.moved_from is None else o.life.moved_from


def _outlines(objects: Sequence[MapObject], colour: Colour, least: float) -> list[Shape]:
    """Return the outlines of the bodies of objects. The outline of a body shorter than `least`, m, is left out, because the
    mark of the object covers it."""
    rims = (body_outline(o) for o in objects)
    return [Line(rim, colour, _LINE) for rim in rims if rim is not None and np.ptp(rim, axis=0).max() >= least]


def _arrows(starts: Floats, ends: Floats, colour: Colour) -> list[Shape]:
    """Return a line from each start (n, 2), m, to its end, with a head in the middle that points to the end."""
    found: list[Shape] = []
    for start, end in zip(starts, ends, strict=True):
        turn = float(np.arctan2(*(end - start)[::-1]))
        found.append(Line(np.stack([start, end]), colour, _LINE))
        found.append(Marks(((start + end) / 2)[None], "triangle", colour, colour, _ARROW, turn=turn))
    return found


def _labels(
    figure: Figure, items: Sequence[tuple[str, MapObject]], points: Floats, names: Sequence[str]
) -> tuple[Label, ...]:
    """Return the labels of the objects. Objects that changed come first. A label without a free place is left out."""
    order = sorted(range(len(items)), key=lambda k: items[k][0] in ("confirmed", "unconfirmed"))
    items, points, names = [items[k] for k in order], points[order], [names[k] for k in order]
    rims = [rim for _, o in items if (rim := body_outline(o)) is not None]
    avoid = np.concatenate([np.zeros((0, 2)), *(drawn_points(figure.pixels(rim)) for rim in rims)])
    return make_labels(figure, names, [_LOOKS[outcome].colour for outcome, _ in items], points, avoid)
