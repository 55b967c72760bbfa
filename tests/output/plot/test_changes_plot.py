"""The picture of what became of objects, read off the figure before it is drawn."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.core.bodies.body import Body
from objslam.core.object_map import Life, MapObject
from objslam.output.plot.changes_plot import changes_figure
from objslam.output.plot.figure import Figure, Line, Marks
from objslam.output.plot.page import render

OUTCOMES = ("confirmed", "unconfirmed", "new", "moved", "gone")


def objects(**changes: Any) -> list[MapObject]:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    return [replace(o, **changes) for o in result.map.objects]


def marks(figure: Figure) -> dict[str, Marks]:
    return {shape.name.split(" (")[0]: shape for shape in figure.shapes if isinstance(shape, Marks) and shape.name}


def test_each_outcome_has_a_mark_of_its_own_at_its_objects() -> None:
    items = [(OUTCOMES[k % 5], o) for k, o in enumerate(objects())]
    figure = changes_figure(items, "changes")
    found = marks(figure)
    assert tuple(found) == OUTCOMES
    assert len({(one.kind, one.colour) for one in found.values()}) == 5
    for outcome, one in found.items():
        mine = np.array([o.position[:2] for name, o in items if name == outcome])
        np.testing.assert_array_equal(one.points, mine)
        words = ": only one had it in view" if outcome == "unconfirmed" else ""
        assert one.name == f"{outcome} ({len(mine)}){words}"
    assert sorted(label.text for label in figure.labels) == sorted(f"{o.label} #{o.id}" for _, o in items)


def test_an_object_that_moved_has_an_arrow_from_where_it_was() -> None:
    was = np.array([1.0, -2.0, 0.5])
    first, *others = objects()
    moved = replace(first, life=Life("moved", 1.0, 2, 2, 9, 9, 0.0, was))
    figure = changes_figure([("moved", moved), *(("confirmed", o) for o in others)], "changes")
    (line,) = (shape for shape in figure.shapes if isinstance(shape, Line))
    np.testing.assert_array_equal(line.points, [was[:2], first.position[:2]])
    (head,) = (shape for shape in figure.shapes if isinstance(shape, Marks) and shape.kind == "triangle")
    way = first.position[:2] - was[:2]
    np.testing.assert_allclose([np.cos(head.turn), np.sin(head.turn)], way / np.linalg.norm(way))
    assert (figure.low < was[:2]).all()
    assert (was[:2] < figure.high).all()


def test_a_body_has_its_outline_if_its_mark_does_not_cover_it() -> None:
    large = Body("cuboid", np.array([1.0, 0.5, 0.8]), 0.0, np.full(3, 0.01), 0.1)
    first, second, *others = objects()
    items = [replace(first, body=large), replace(second, body=replace(large, size=np.full(3, 0.01))), *others]
    figure = changes_figure([("new", o) for o in items], "changes")
    (line,) = (shape for shape in figure.shapes if isinstance(shape, Line))
    np.testing.assert_allclose(np.ptp(line.points, axis=0), [1.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(line.points[:-1].mean(axis=0), first.position[:2], atol=1e-9)


def test_a_room_without_a_path_is_shown_whole_and_a_phantom_far_away_is_not() -> None:
    corner = np.array([-3.0, -2.5, 1.0])
    room = [np.array([x, y, 1.0]) for x in (0.8, 1.6, 3.0, 3.5) for y in (0.0, 1.2, 2.4)]
    model = objects()[0]
    items = [replace(model, id=k, position=p) for k, p in enumerate([*room, corner, np.array([900.0, 40.0, 0.0])])]
    figure = changes_figure([("confirmed", o) for o in items], "objects")
    assert len(marks(figure)["confirmed"].points) == len(room) + 1
    assert figure.title == "objects, 1 far away not shown"


@pytest.mark.parametrize("kind", ["plus", "x", "diamond", "triangle"])
def test_a_mark_is_drawn_where_it_is(kind: str) -> None:
    """The mark is as large as it says, and its pixels lie evenly around its centre."""
    mark = Marks(np.array([[2.0, 1.0]]), kind, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 40.0)  # type: ignore[arg-type]
    figure = Figure("", ("x", "y"), np.zeros(2), np.array([4.0, 2.0]), 100.0, (mark,))
    drawn = cv2.imdecode(np.frombuffer(render(figure), np.uint8), cv2.IMREAD_GRAYSCALE)
    without = cv2.imdecode(np.frombuffer(render(replace(figure, shapes=())), np.uint8), cv2.IMREAD_GRAYSCALE)
    y, x = np.nonzero(drawn.astype(int) - without < -100)
    assert 30 <= np.ptp(x) <= 42
    assert 25 <= np.ptp(y) <= 42
    if kind != "triangle":
        np.testing.assert_allclose(x.mean(), x.min() + np.ptp(x) / 2, atol=0.5)
        np.testing.assert_allclose(y.mean(), y.min() + np.ptp(y) / 2, atol=0.5)


def test_no_object_is_a_picture_too() -> None:
    assert render(changes_figure([], "0 objects")).startswith(b"\x89PNG")


def test_labels_leave_the_outlines_of_bodies_free() -> None:
    """Also the sides of a cuboid, which are drawn between its corners."""
    body = Body("cuboid", np.array([1.2, 0.9, 0.8]), 0.0, np.full(3, 0.01), 0.1)
    model = objects()[0]
    at = [np.array([x, y, 0.4]) for x in (0.0, 3.0, 6.0) for y in (0.0, 3.0)]
    items = [replace(model, id=k, label="a long name", position=p, body=body) for k, p in enumerate(at)]
    figure = changes_figure([("new", o) for o in items], "changes")
    rims = [figure.pixels(shape.points) for shape in figure.shapes if isinstance(shape, Line)]
    assert len(figure.labels) == len(rims) == len(items)
    along = np.concatenate([a + np.linspace(0, 1, 500)[:, None] * (b - a) for rim in rims for a, b in pairwise(rim)])
    for label in figure.labels:
        assert not ((along > label.box[:2]) & (along < label.box[2:])).all(axis=1).any()
