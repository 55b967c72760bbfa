"""map.png: what it shows, read off the figure before it is drawn, and what of it is in the drawn picture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.core.arrays import Floats
from objslam.core.result import Doubt, DoubtKind
from objslam.output.plot.canvas import blank, draw_line, draw_segments, draw_text, text_width
from objslam.output.plot.figure import Area, Figure, Line, Marks, Segments
from objslam.output.plot.map_plot import _DOUBT, draw_map, map_figure
from objslam.output.plot.page import FONT, wrapped
from objslam.output.plot.style import captions


def lines(figure: Figure) -> dict[str, Floats]:
    """The points of the lines and marks that have a name."""
    return {shape.name: shape.points for shape in figure.shapes if isinstance(shape, Line | Marks) and shape.name}


def texts(figure: Figure) -> list[str]:
    return [label.text for label in figure.labels]


def areas(figure: Figure) -> list[Area]:
    return [shape for shape in figure.shapes if isinstance(shape, Area)]


def picture(file: Path) -> Any:
    """The picture in a file, as an array (H, W, 3), BGR."""
    import cv2

    image = cv2.imread(str(file))
    assert image is not None
    return image


def test_the_room() -> None:
    positions, labels = clusters()
    result, truth = synthetic_result(positions, labels, keyframes=300, unresolved=(4,))
    figure = map_figure(result, truth)
    assert sorted(texts(figure)) == sorted(labels)
    assert figure.title == "14 objects and 1 unresolved from 4,500 rays of 300 keyframes, joint mode"
    named = lines(figure)
    np.testing.assert_array_equal(named["path after"], result.map_T_base[:, :2, 3])
    np.testing.assert_array_equal(named["path before"], result.path.poses[:, :2, 3])
    np.testing.assert_array_equal(named["start"], result.map_T_base[:1, :2, 3])
    np.testing.assert_array_equal(named["ground truth"], positions[:, :2])
    rejected = int(((result.weight < 0.5) & (result.association.object >= 0)).sum())
    rays = [shape.name for shape in figure.shapes if isinstance(shape, Segments)]
    assert rays == ["rays", f"rejected rays ({rejected})"]
    assert [entry.name for entry in figure.legend] == ["objects, 2 sigma", "unresolved"]
    assert ((figure.low < positions[:, :2]) & (positions[:, :2] < figure.high)).all()


def test_a_true_path_is_drawn_in_the_plane_of_the_map() -> None:
    result, truth = synthetic_result(*clusters(), keyframes=30)
    assert truth.trajectory is not None
    np.testing.assert_array_equal(lines(map_figure(result, truth))["true path"], truth.trajectory.poses[:, :2, 3])
    assert "true path" not in lines(map_figure(result, dataclasses.replace(truth, trajectory=None)))


def test_the_picture_shows_each_object_in_its_place_and_colour(tmp_path: Path) -> None:
    positions, labels = clusters()
    result, truth = synthetic_result(positions, labels, keyframes=30)
    draw_map(result, tmp_path / "map.png", truth)
    image, figure = picture(tmp_path / "map.png").astype(int), map_figure(result, truth)
    assert (image[0] == 255).all()  # the white margin
    assert (image[:, 0] == 255).all()
    dots = [shape for shape in figure.shapes if isinstance(shape, Marks) and not shape.name]
    centres = figure.pixels(np.concatenate([dot.points for dot in dots])).round().astype(int)
    colours = np.array([np.round(255 * np.array(dot.colour[::-1])) for dot in dots])
    # Where the shown area lies in the page is found from the dots themselves: one shift fits all of them.
    height, width = image.shape[:2]
    fits = [
        (left, top)
        for left in range(width - figure.size[0])
        for top in range(height - figure.size[1])
        if (np.abs(image[centres[0, 1] + top, centres[0, 0] + left] - colours[0]) <= 1).all()
        and (np.abs(image[centres[:, 1] + top, centres[:, 0] + left] - colours) <= 1).all()
    ]
    assert fits


def test_segments_get_darker_where_they_overlap_and_have_the_cover_of_their_slope() -> None:
    once, twice, slanted = blank(40, 40), blank(40, 40), blank(40, 40)
    level = np.array([[[5.0, 20.0], [30.0, 20.0]]])
    draw_segments(once, level, (0.0, 0.0, 0.0), 0.4)
    draw_segments(twice, np.concatenate([level, level[:, ::-1]]), (0.0, 0.0, 0.0), 0.4)
    assert once[20, 5:31].tolist() == [[153] * 3] * 26
    assert twice[20, 5:31].tolist() == [[92] * 3] * 26  # 255 * 0.6^2
    assert int((once < 255).any(axis=2).sum()) == 26
    draw_segments(slanted, np.array([[[4.0, 2.0], [16.0, 34.0]], [[-1e9, 7.0], [-1e8, 9.0]]]), (0.0, 0.0, 0.0), 0.9)
    cover = np.log(slanted[..., 0] / 255) / np.log(0.1)
    np.testing.assert_allclose(cover[2:35].sum(axis=1), 1.0, atol=0.02)
    rows = np.arange(2, 35)
    np.testing.assert_allclose(cover[2:35] @ np.arange(40), 4 + (rows - 2) * 12 / 32, atol=0.3)


def test_a_dashed_line_has_dashes_and_gaps() -> None:
    image = blank(100, 20)
    draw_line(image, np.array([[10.0, 10.0], [90.0, 10.0]]), (0.0, 0.0, 0.0), 1, (12.0, 8.0))
    dark = image[10, :, 0] < 128
    assert dark[[12, 16, 20, 32, 36, 40, 52, 72]].all()
    assert not dark[[5, 26, 27, 46, 47, 66, 67, 95]].any()
    turned = blank(100, 100)  # only what is inside costs anything, however long the line is
    far = np.array([[-1e6, 50.0], [1e6, 50.0], [50.0, 1e6], [50.0, -1e6]] * 50)
    draw_line(turned, far, (0.0, 0.0, 0.0), 1, (12.0, 8.0))
    assert (turned[50, :, 0] < 128).any()
    assert (turned[:, 50, 0] < 128).any()


def test_lines_far_outside_and_without_points_can_be_drawn() -> None:
    image = blank(30, 30)
    draw_line(image, np.array([[15.0, -1e12], [15.0, 1e12]]), (0.0, 0.0, 0.0), 1)
    assert (image[:, 15] < 128).all()
    for points in (np.zeros((0, 2)), np.ones((1, 2)), np.full((3, 2), np.nan)):
        for dash in (None, (8.0, 4.0)):
            draw_line(image, points, (0.0, 0.0, 0.0), 1, dash)


@pytest.mark.parametrize(("sigma", "whole"), [(0.6, True), (1.1, True), (500.0, False)])
def test_an_ellipse_is_in_the_picture_as_long_as_it_leaves_room_for_the_map(sigma: float, whole: bool) -> None:
    positions, labels = clusters()
    result, _ = synthetic_result(positions, labels, keyframes=50)
    objects = list(result.map.objects)
    for j, axis in ((0, 0), (int(positions[:, 1].argmax()), 1)):
        covariance = 1e-4 * np.eye(3)
        covariance[axis, axis] = sigma**2
        objects[j] = dataclasses.replace(objects[j], covariance=covariance)
    plain = map_figure(result)
    figure = map_figure(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(objects))))
    top = int(positions[:, 1].argmax())
    end = objects[top].position[1] + 2 * sigma
    assert (end < figure.high[1]) == whole
    assert (figure.high - figure.low).max() < 3.2 * (plain.high - plain.low).max()


def test_labels_do_not_overlap_in_the_saved_picture() -> None:
    rng = np.random.default_rng(3)
    positions = np.column_stack([rng.uniform(0.8, 2.2, 25), rng.uniform(1.6, 2.4, 25), np.full(25, 0.8)])
    labels = ["cup"] * 5 + ["book"] * 8 + ["teddy bear"] * 4 + ["keyboard"] * 8
    result, _ = synthetic_result(positions, labels, keyframes=100, room=(3.0, 4.0))
    figure = map_figure(result)
    boxes = [label.box for label in figure.labels]
    assert len(boxes) == 25
    for i, a in enumerate(boxes):
        assert ((a[:2] >= 0) & (a[2:] <= figure.size)).all()
        for b in boxes[:i]:
            assert not ((a[:2] < b[2:]) & (b[:2] < a[2:])).all()
    for label in figure.labels:  # the drawn letters keep within the box
        drawn = blank(*figure.size)
        draw_text(drawn, label.text, (float(label.box[0]), float(label.box[1])), FONT, (0.0, 0.0, 0.0))
        rows, columns = np.nonzero((drawn < 250).any(axis=2))
        assert columns.min() >= label.box[0] - 2
        assert columns.max() <= label.box[2] + 2
        assert rows.min() >= label.box[1] - 2
        assert rows.max() <= label.box[3] + 2


def test_labels_leave_ellipses_and_crosses_free() -> None:
    positions = np.array([[2.0, 2.0, 0.5], [8.0, 4.0, 0.5], [5.0, 12.0, 0.5], [2.0, 9.0, 0.5], [8.0, 9.0, 0.5]])
    result, truth = synthetic_result(positions, ["cup"] * 5, keyframes=60, sigma=0.1)
    figure = map_figure(result, truth)
    arm = 8.5 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    crosses = figure.pixels(positions[:, :2])[:, None] + arm
    rims = np.concatenate([figure.pixels(area.rim) for area in areas(figure)])
    assert len(figure.labels) == 5
    for label in figure.labels:
        for points in (crosses.reshape(-1, 2), rims):
            assert not ((points > label.box[:2]) & (points < label.box[2:])).all(axis=1).any()


def test_ellipses_are_two_sigma_in_the_plane() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=30, unresolved=(0,))
    ellipses = areas(map_figure(result))
    resolved = result.map.resolved()
    assert len(ellipses) == len(resolved)
    for shape, o in zip(ellipses, resolved, strict=True):
        assert o.covariance is not None
        off = shape.rim - o.position[:2]
        distance = np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(o.covariance[:2, :2]), off))
        np.testing.assert_allclose(distance, 2.0, rtol=1e-6)


def test_a_triangle_at_the_edge_points_to_a_far_object() -> None:
    positions, labels = clusters()
    positions[3, :2] = [500, -900]
    figure = map_figure(synthetic_result(positions, labels, keyframes=50)[0])
    low, high = figure.low, figure.high
    assert (high - low < [20, 25]).all()
    (triangle,) = (shape for shape in figure.shapes if isinstance(shape, Marks) and shape.kind == "triangle")
    (at,) = triangle.points
    assert ((at >= low) & (at <= high)).all()
    way = np.array([500, -900]) - (low + high) / 2
    ahead = triangle.turn
    np.testing.assert_allclose([np.cos(ahead), np.sin(ahead)], way / np.linalg.norm(way), atol=1e-3)
    (text,) = (text for text in texts(figure) if text.startswith(labels[3]))
    assert abs(float(text.split(", ")[1].removesuffix(" m out")) - np.linalg.norm([500, -900] - at)) < 0.06


def test_a_world_with_y_down_is_drawn_from_above() -> None:
    """The map of the same drive with every pose and point turned: the picture has the same points, on other axes."""
    result, _ = synthetic_result(*clusters(), keyframes=50)
    y_down = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    keyframes = result.keyframes
    poses = keyframes.map_T_base.copy()
    poses[:, 2, 3] += np.sin(np.arange(len(poses)))  # held in a hand, for a planar path tells where up is
    moved = [
        dataclasses.replace(
            o, position=y_down[:3, :3] @ o.position, covariance=y_down[:3, :3] @ o.covariance @ y_down[:3, :3].T
        )
        for o in result.map.objects
    ]
    turned = dataclasses.replace(
        result,
        map=dataclasses.replace(result.map, objects=tuple(moved)),
        keyframes=dataclasses.replace(keyframes, map_T_base=y_down @ poses),
        map_T_base=y_down @ result.map_T_base,
        path=dataclasses.replace(result.path, poses=y_down @ result.path.poses),
        path_after=dataclasses.replace(result.path_after, poses=y_down @ result.path_after.poses),
        origins=result.origins @ y_down[:3, :3].T,
        directions=result.directions @ y_down[:3, :3].T,
    )
    before, after = map_figure(result), map_figure(turned)
    assert after.axes == ("x", "z")
    np.testing.assert_allclose(lines(after)["path after"], lines(before)["path after"], atol=1e-9)
    for one, other in zip(areas(after), areas(before), strict=True):
        for corner in np.eye(2):  # eigenvectors have no sign, so the points of an ellipse may come in another order
            assert (one.rim @ corner).max() == pytest.approx((other.rim @ corner).max(), abs=2e-3)


def test_a_path_before_that_drifted_off_does_not_squeeze_the_map() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=50)
    poses = result.path.poses.copy()
    poses[:, 0, 3] += np.linspace(0, 5000, 50)
    figure = map_figure(dataclasses.replace(result, path=dataclasses.replace(result.path, poses=poses)))
    assert figure.high[0] - figure.low[0] < 20


def test_in_fixed_mode_there_is_one_path() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    named = lines(map_figure(dataclasses.replace(result, map_T_base=result.keyframes.map_T_base)))
    assert "path" in named
    assert "path before" not in named


@pytest.mark.parametrize(("level", "headline"), [("good", ""), ("check", "Look closer."), ("bad", "Do not use this map.")])
def test_the_picture_of_a_doubtful_map_says_so(tmp_path: Path, level: str, headline: str) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    reasons = ["12 % of the boxes belong to no object." for _ in range(12)]
    judged = dataclasses.replace(result, summary={**result.summary, "assessment": {"level": level, "reasons": reasons}})
    figure = map_figure(judged)
    assert figure.warning == (f"{headline} {' '.join(reasons)}" if headline else "")
    draw_map(judged, tmp_path / "map.png")
    above = picture(tmp_path / "map.png")[:120].astype(int)
    red = above[..., 2] - above[..., :2].max(axis=-1) > 100
    assert red.any() == bool(headline)


def test_a_warning_is_wrapped_at_words() -> None:
    words = " ".join(["measured"] * 40)
    lines = wrapped(words, 300, FONT, 3)
    assert len(lines) == 3
    assert all(text_width(line, FONT) <= 300 for line in lines)
    assert lines[2].endswith(" …")
    assert wrapped("two words", 300, FONT, 3) == ["two words"]
    assert wrapped("", 300, FONT, 3) == []
    assert wrapped("x" * 200, 300, FONT, 3) == ["x" * 200]


def test_few_of_many_rays_are_drawn() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=400)
    rays, rejected = (shape for shape in map_figure(result).shapes if isinstance(shape, Segments))
    assert len(rays.ends) == 2000
    assert len(rejected.ends) == 400


@pytest.mark.parametrize(
    "label", ["a $x_1$ b $", "$\\nope$", "new\nline", "杯子", "\\frac{1}{2}", "x" * 300, "_hidden", "[red]"]
)
def test_any_label_can_be_drawn(tmp_path: Path, label: str) -> None:
    result, truth = synthetic_result(np.array([[3.0, 4.0, 1.0]]), [label], keyframes=2)
    figure = map_figure(result, truth)
    (text,) = texts(figure)
    draw_map(result, tmp_path / "map.png", truth)
    assert picture(tmp_path / "map.png").shape[1] > figure.size[0]
    assert len(text) <= 28
    assert text.startswith(" ".join(label.split())[:20])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_next_to_nothing_can_be_drawn(tmp_path: Path, count: int) -> None:
    result, truth = synthetic_result(np.ones((count, 3)), ["cup"] * count, keyframes=2, unresolved=(0,))
    assert f"{max(count - 1, 0)} object" in map_figure(result, truth).title
    draw_map(result, tmp_path / "map.png", truth)
    assert picture(tmp_path / "map.png").min() < 100


def test_an_object_without_covariance_or_place_can_be_drawn(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=3, unresolved=(0,))
    objects = list(result.map.objects)
    objects[0] = dataclasses.replace(objects[0], position=np.full(3, np.nan))
    objects[1] = dataclasses.replace(objects[1], covariance=None)
    objects[2] = dataclasses.replace(objects[2], covariance=np.full((3, 3), np.nan))
    changed = dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(objects)))
    assert len(areas(map_figure(changed))) == 12
    draw_map(changed, tmp_path / "map.png")
    assert picture(tmp_path / "map.png").min() < 100


def test_likely_doubts_mark_their_objects() -> None:
    """An unlikely double and a wide sigma mark nothing, and neither does a doubt about an object without a position."""
    result, _ = synthetic_result(*clusters(), keyframes=20)
    first, second, third, *_ = (o.id for o in result.map.resolved())
    lost = dataclasses.replace(result.map.objects[-1], status="unresolved", position=np.full(3, np.nan), covariance=None)
    result = dataclasses.replace(result, map=dataclasses.replace(result.map, objects=(*result.map.objects[:-1], lost)))

    def doubt(kind: DoubtKind, *objects: int, **numbers: float) -> Doubt:
        return Doubt(kind, "reason", "label", "A sentence.", objects, None, np.zeros(0, dtype=np.int64), numbers)

    doubts = (
        doubt("pair", first, second, probability=0.4),
        doubt("pair", first, lost.id, probability=0.6),
        doubt("moved", third),
        doubt("unsure", second),
    )
    figure = map_figure(dataclasses.replace(result, doubts=doubts))
    marked = [text for text in texts(figure) if text.endswith(" ?")]
    named = zip(result.map, captions(result.map), strict=True)
    assert sorted(marked) == sorted(f"{name} ?" for o, name in named if o.id in (first, third))
    orange = [one for one in figure.shapes if isinstance(one, Marks) and one.rim == _DOUBT]
    assert len(orange) == 2
    assert any("doubtful" in one.name for one in figure.legend)
    assert not any("doubtful" in one.name for one in map_figure(result).legend)


def test_of_a_great_many_objects_those_with_most_rays_are_named() -> None:
    rng = np.random.default_rng(0)
    positions = np.column_stack([rng.uniform(0, 10, (400, 2)), np.ones(400)])
    result, _ = synthetic_result(positions, [f"o{i}" for i in range(400)], keyframes=30)
    objects = tuple(dataclasses.replace(o, rays=int(i % 4 == 0)) for i, o in enumerate(result.map.objects))
    figure = map_figure(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=objects)))
    named = texts(figure)
    assert figure.note == f"{400 - len(named)} labels have no room"
    assert 70 < sum(int(name[1:]) % 4 == 0 for name in named) <= 100
    assert len(named) <= 150
