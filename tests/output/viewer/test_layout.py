"""Where the map is seen from and labels hang: everything in view, nothing on top of something else."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_result import clusters, synthetic_result

from objslam.core.types import Images, Up
from objslam.frontend.up import from_above, up_vector
from objslam.output.viewer.images import choose_images
from objslam.output.viewer.view_point import first_view_point, label_places, label_rows, look_at

VIEW = np.array([900.0, 620.0])


def test_the_first_look_has_everything_in_it_and_is_filled() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=60)
    path = result.map_T_base[:, :3, 3]
    view_point = first_view_point(result.map, path)
    places = np.concatenate([[o.position for o in result.map.objects], path])
    pixels, depth = view_point.project(places)
    assert view_point.has_in_view(places).all()
    assert (depth > 0).all()
    spread = np.ptp(pixels, axis=0) / VIEW
    assert spread.max() > 0.6
    np.testing.assert_allclose((pixels.max(axis=0) + pixels.min(axis=0)) / 2, VIEW / 2, atol=60)
    assert view_point.position[2] > places[:, 2].max()


@pytest.mark.parametrize("up", ["z", "-y", "x", "-z"])
def test_the_first_look_is_from_above_whatever_axis_points_up(up: Up) -> None:
    """A map that is turned as a whole looks the same from its first view point."""
    result, _ = synthetic_result(*clusters(), keyframes=60)
    path = result.map_T_base[:, :3, 3]
    turn = np.stack([*np.eye(3)[from_above(up)], up_vector(up)], axis=1)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    moved = dataclasses.replace(
        result.map, objects=tuple(dataclasses.replace(o, position=turn @ o.position) for o in result.map.objects)
    )
    pixels, _ = first_view_point(result.map, path).project(path)
    np.testing.assert_allclose(first_view_point(moved, path @ turn.T, up).project(path @ turn.T)[0], pixels, atol=25.0)


def test_what_is_higher_in_the_map_is_higher_in_the_view() -> None:
    view_point = look_at(np.zeros(3), np.array([0.0, -1.0, 0.5]), 5.0)
    pixels, depth = view_point.project(np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(pixels[0], VIEW / 2)
    assert depth[0] == pytest.approx(5.0)
    assert pixels[1, 1] < pixels[0, 1]  # up
    assert pixels[2, 0] > pixels[0, 0]  # east is right, seen from the south
    assert depth[3] > depth[0]
    moved = np.array([[0.0, 0, 0]]) + view_point.offset(np.array([[30.0, -20.0]]), np.array([5.0]))
    np.testing.assert_allclose(view_point.project(moved)[0], VIEW / 2 + [[30, -20]])


def test_labels_cover_neither_each_other_nor_dots() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=60)
    path = result.map_T_base[:, :3, 3]
    view_point = first_view_point(result.map, path)
    anchors = np.stack([o.position for o in result.map.objects])
    texts = [o.label for o in result.map.objects]
    hung, ends = label_places(view_point, anchors, texts, path)
    top, dots = view_point.project(hung)[0], view_point.project(anchors)[0]
    half = (np.array([len(t) for t in texts]) * 7.3 + 12) / 2
    boxes = np.column_stack([top[:, 0] - half, top[:, 1], top[:, 0] + half, top[:, 1] + 24])
    assert count_overlaps(boxes) == 0
    inside = (dots[None] > boxes[:, None, :2]) & (dots[None] < boxes[:, None, 2:])
    assert not inside.all(axis=2).any()
    # the line of each ends at its label
    tips = view_point.project(ends)[0]
    assert ((tips >= boxes[:, :2] - 1) & (tips <= boxes[:, 2:] + 1)).all()
    assert label_places(view_point, np.zeros((0, 3)), [], path)[0].shape == (0, 3)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 4), st.floats(0, 639), st.floats(0, 479), st.integers(1, 14)), min_size=0, max_size=60)
)
def test_names_in_an_image_never_overlap(dots: list[tuple[int, float, float, int]]) -> None:
    frame = np.array([d[0] for d in dots], dtype=np.int64)
    places = np.array([d[1:3] for d in dots]).reshape(-1, 2)
    letters = np.array([d[3] for d in dots], dtype=np.int64)
    hung, found = label_rows(frame, places, letters, (640, 480))
    scale = min(580 / 640, 350 / 480)
    half = (letters * 7.3 + 12) / 2 / scale
    for k in range(5):
        mine = found & (frame == k)
        boxes = np.column_stack([hung[:, 0] - half, hung[:, 1], hung[:, 0] + half, hung[:, 1] + 21 / scale])[mine]
        assert count_overlaps(boxes) == 0
    np.testing.assert_array_equal(hung[:, 0], places[:, 0])
    assert (hung[found, 1] >= places[found, 1] - 1e-6).all()
    if len(dots) == 1:
        assert found.all()


def count_overlaps(boxes: np.ndarray) -> int:
    low, high = boxes[:, :2] + 1e-6, boxes[:, 2:] - 1e-6
    hit = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(axis=2)
    return int(np.triu(hit, 1).sum())


def test_images_are_chosen_evenly_and_only_where_there_is_one() -> None:
    images = Images(0.1 * np.arange(100), tuple(Path(f"{i}.jpg") for i in range(100)))
    stamps = np.array([-1.0, 0.02, 0.31, 5.0, 9.9, 9.97, 20.0])
    shown, which = choose_images(images, stamps, 10)
    assert shown.tolist() == [1, 2, 3, 4]  # 9.97 is too far from the last
    assert which.tolist() == [0, 3, 50, 99]
    shown, which = choose_images(images, 0.1 * np.arange(100), 4)
    assert shown.tolist() == which.tolist() == [0, 33, 66, 99]
    assert len(choose_images(images, stamps, 0)[0]) == len(choose_images(Images(np.zeros(0), ()), stamps, 5)[0]) == 0
    assert choose_images(Images(np.array([5.0]), (Path("a"),)), stamps, 5)[0].tolist() == [3]
