"""map.png: what it shows, read off the figure right before it is saved."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.core.result import RunResult
from objslam.core.types import Truth
from objslam.output.plot.map_plot import draw_map


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Draws a map and gives the figure that was saved."""
    from matplotlib.figure import Figure

    figures: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *args: Any, **kwargs: Any) -> None:
        figures.append(figure)
        save(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", keep)

    def draw(result: RunResult, truth: Truth | None = None) -> Figure:
        file = tmp_path / "map.png"
        draw_map(result, file, truth)
        assert file.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        return figures[-1]

    return draw


def texts(figure: Any) -> list[str]:
    return [t.get_text() for t in figure.axes[0].texts]


def lines(figure: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in figure.axes[0].lines}


def test_the_room(drawn: Any) -> None:
    positions, labels = clusters()
    result, truth = synthetic_result(positions, labels, keyframes=300, unresolved=(4,))
    figure = drawn(result, truth)
    axes = figure.axes[0]
    assert sorted(texts(figure)) == sorted(labels)
    assert axes.get_aspect() == 1.0
    assert axes.get_xlabel() == "x (m)"
    title = axes.get_title(loc="left")
    assert title == "14 objects and 1 unresolved from 4,500 rays of 300 keyframes, joint mode"
    named = lines(figure)
    np.testing.assert_array_equal(named["path after"].get_xydata(), result.map_T_base[:, :2, 3])
    np.testing.assert_array_equal(named["path before"].get_xydata(), result.path.poses[:, :2, 3])
    np.testing.assert_array_equal(named["start"].get_xydata(), result.map_T_base[:1, :2, 3])
    np.testing.assert_array_equal(named["ground truth"].get_xydata(), positions[:, :2])
    legend = [t.get_text() for t in figure.legends[0].get_texts()]
    rejected = int(((result.weight < 0.5) & (result.association.object >= 0)).sum())
    assert f"rejected rays ({rejected})" in legend
    assert {"rays", "path before", "path after", "start", "ground truth", "objects, 2 sigma", "unresolved"} <= set(legend)
    x, y = np.array(axes.get_xlim()), np.array(axes.get_ylim())
    assert ((x[0] < positions[:, 0]) & (positions[:, 0] < x[1])).all()
    assert ((y[0] < positions[:, 1]) & (positions[:, 1] < y[1])).all()


@pytest.mark.parametrize(("sigma", "whole"), [(0.6, True), (500.0, False)])
def test_an_ellipse_is_in_the_picture_as_long_as_it_leaves_room_for_the_map(drawn: Any, sigma: float, whole: bool) -> None:
    positions, labels = clusters()
    result, _ = synthetic_result(positions, labels, keyframes=50)
    objects = list(result.map.objects)
    for j, axis in ((0, 0), (int(positions[:, 1].argmax()), 1)):
        covariance = 1e-4 * np.eye(3)
        covariance[axis, axis] = sigma**2
        objects[j] = dataclasses.replace(objects[j], covariance=covariance)
    plain = drawn(result).axes[0]
    before = [np.ptp(plain.get_xlim()), np.ptp(plain.get_ylim())]
    axes = drawn(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(objects)))).axes[0]
    top = int(positions[:, 1].argmax())
    end = objects[top].position[1] + 2 * sigma
    assert (end < axes.get_ylim()[1]) == whole
    assert max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())) < 3.2 * max(before)


def test_labels_do_not_overlap_in_the_saved_picture(drawn: Any) -> None:
    rng = np.random.default_rng(3)
    positions = np.column_stack([rng.uniform(0.8, 2.2, 25), rng.uniform(1.6, 2.4, 25), np.full(25, 0.8)])
    labels = ["cup"] * 5 + ["book"] * 8 + ["teddy bear"] * 4 + ["keyboard"] * 8
    result, _ = synthetic_result(positions, labels, keyframes=100, room=(3.0, 4.0))
    figure = drawn(result)
    renderer = figure.canvas.get_renderer()
    boxes = [t.get_window_extent(renderer) for t in figure.axes[0].texts]
    assert len(boxes) == 25
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert not (a.x0 < b.x1 and b.x0 < a.x1 and a.y0 < b.y1 and b.y0 < a.y1)


def test_labels_leave_ellipses_and_crosses_free(drawn: Any) -> None:
    positions = np.array([[2.0, 2.0, 0.5], [8.0, 4.0, 0.5], [5.0, 12.0, 0.5], [2.0, 9.0, 0.5], [8.0, 9.0, 0.5]])
    result, truth = synthetic_result(positions, ["cup"] * 5, keyframes=60, sigma=0.1)
    figure = drawn(result, truth)
    axes, renderer = figure.axes[0], figure.canvas.get_renderer()
    arm = 4 * figure.dpi / 72
    crosses = axes.transData.transform(positions[:, :2])[:, None] + arm * np.array(
        [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]
    )
    rims = np.concatenate([ellipse.get_verts() for ellipse in axes.patches])  # px
    for box in [t.get_window_extent(renderer) for t in axes.texts]:
        low, high = [box.x0, box.y0], [box.x1, box.y1]
        for points in (crosses.reshape(-1, 2), rims):
            assert not ((points > low) & (points < high)).all(axis=1).any()


def test_ellipses_are_two_sigma_in_the_plane(drawn: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=30, unresolved=(0,))
    ellipses = drawn(result).axes[0].patches
    resolved = result.map.resolved()
    assert len(ellipses) == len(resolved)
    for shape, o in zip(ellipses, resolved, strict=True):
        assert o.covariance is not None
        circle = np.column_stack([np.cos(np.linspace(0, 6, 30)), np.sin(np.linspace(0, 6, 30))])
        off = shape.get_patch_transform().transform(circle) - o.position[:2]
        distance = np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(o.covariance[:2, :2]), off))
        np.testing.assert_allclose(distance, 2.0, rtol=1e-6)


def test_a_triangle_at_the_edge_points_to_a_far_object(drawn: Any) -> None:
    positions, labels = clusters()
    positions[3, :2] = [500, -900]
    figure = drawn(synthetic_result(positions, labels, keyframes=50)[0])
    axes = figure.axes[0]
    assert np.ptp(axes.get_xlim()) < 20
    assert np.ptp(axes.get_ylim()) < 25
    (triangle,) = (line for line in axes.get_lines() if isinstance(line.get_marker(), tuple))
    (at,) = triangle.get_xydata()
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    assert ((at >= low) & (at <= high)).all()
    way = np.array([500, -900]) - (low + high) / 2
    ahead = np.radians(triangle.get_marker()[2] + 90)
    np.testing.assert_allclose([np.cos(ahead), np.sin(ahead)], way / np.linalg.norm(way), atol=1e-3)
    (text,) = (text for text in texts(figure) if text.startswith(labels[3]))
    assert abs(float(text.split(", ")[1].removesuffix(" m out")) - np.linalg.norm([500, -900] - at)) < 0.06


def test_a_world_with_y_down_is_drawn_from_above(drawn: Any) -> None:
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
    before, after = drawn(result), drawn(turned)
    assert (after.axes[0].get_xlabel(), after.axes[0].get_ylabel()) == ("x (m)", "z (m)")
    np.testing.assert_allclose(lines(after)["path after"].get_xydata(), lines(before)["path after"].get_xydata(), atol=1e-9)
    for one, other in zip(after.axes[0].patches, before.axes[0].patches, strict=True):
        assert [*one.center, one.width, one.height] == pytest.approx([*other.center, other.width, other.height])


def test_a_path_before_that_drifted_off_does_not_squeeze_the_map(drawn: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=50)
    poses = result.path.poses.copy()
    poses[:, 0, 3] += np.linspace(0, 5000, 50)
    axes = drawn(dataclasses.replace(result, path=dataclasses.replace(result.path, poses=poses))).axes[0]
    assert np.ptp(axes.get_xlim()) < 20


def test_in_fixed_mode_there_is_one_path(drawn: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    named = lines(drawn(dataclasses.replace(result, map_T_base=result.keyframes.map_T_base)))
    assert "path" in named
    assert "path before" not in named


def test_few_of_many_rays_are_drawn(drawn: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=400)
    rays, rejected = drawn(result).axes[0].collections
    assert len(rays.get_segments()) == 2000
    assert len(rejected.get_segments()) == 400


@pytest.mark.parametrize(
    "label", ["a $x_1$ b $", "$\\nope$", "new\nline", "杯子", "\\frac{1}{2}", "x" * 300, "_hidden", "[red]"]
)
def test_any_label_can_be_drawn(drawn: Any, label: str) -> None:
    result, truth = synthetic_result(np.array([[3.0, 4.0, 1.0]]), [label], keyframes=2)
    (text,) = texts(drawn(result, truth))
    assert len(text) <= 28
    assert text.startswith(" ".join(label.split())[:20])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_next_to_nothing_can_be_drawn(drawn: Any, count: int) -> None:
    result, truth = synthetic_result(np.ones((count, 3)), ["cup"] * count, keyframes=2, unresolved=(0,))
    assert f"{max(count - 1, 0)} object" in drawn(result, truth).axes[0].get_title(loc="left")


def test_an_object_without_covariance_or_place_can_be_drawn(drawn: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=3, unresolved=(0,))
    objects = list(result.map.objects)
    objects[0] = dataclasses.replace(objects[0], position=np.full(3, np.nan))
    objects[1] = dataclasses.replace(objects[1], covariance=None)
    objects[2] = dataclasses.replace(objects[2], covariance=np.full((3, 3), np.nan))
    figure = drawn(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(objects))))
    assert len(figure.axes[0].patches) == 12


def test_of_a_great_many_objects_those_with_most_rays_are_named(drawn: Any) -> None:
    rng = np.random.default_rng(0)
    positions = np.column_stack([rng.uniform(0, 10, (400, 2)), np.ones(400)])
    result, _ = synthetic_result(positions, [f"o{i}" for i in range(400)], keyframes=30)
    objects = tuple(dataclasses.replace(o, rays=int(i % 4 == 0)) for i, o in enumerate(result.map.objects))
    shown = texts(drawn(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=objects))))
    named, note = shown[:-1], shown[-1]
    assert note == f"{400 - len(named)} labels have no room"
    assert 70 < sum(int(name[1:]) % 4 == 0 for name in named) <= 100
    assert len(named) <= 150


def test_drawing_needs_no_screen_no_pyplot_and_not_the_style_of_the_user(tmp_path: Path) -> None:
    style = tmp_path / "matplotlibrc"
    style.write_text("text.usetex: True\nfigure.facecolor: black\n")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import objslam.output.plot.map_plot; assert 'matplotlib' not in sys.modules\n"
        "from pathlib import Path; from synthetic_result import *\n"
        "objslam.output.plot.map_plot.draw_map(synthetic_result(*clusters(), keyframes=3)[0], Path(sys.argv[2]))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "import matplotlib; assert matplotlib.rcParams['text.usetex']\n"
        "from matplotlib.image import imread; assert imread(sys.argv[2])[0, 0].tolist() == [1, 1, 1, 1]\n"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(Path(__file__).parents[2]), str(tmp_path / "a.png")]
    environment = os.environ | {"MATPLOTLIBRC": str(style)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
