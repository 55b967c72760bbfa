"""Decoding against second implementations, and the way of an image into the network and of boxes back."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import expit, softmax

from objslam.detection.postprocess import decode, suppress
from objslam.detection.preprocess import fill, fit
from objslam.detection.recipe import HABITS, InputSize, Recipe
from objslam.errors import DetectorError

SIZE = InputSize(320, 256, free_width=False, free_height=False, stride=32)


def recipe(layout, **changes):
    habits = HABITS[layout]
    values = {
        "layout": layout, "outputs": {}, "size": SIZE, "resize": habits.resize, "pad": 114, "colour": habits.colour,
        "divide_by": habits.divide_by, "mean": (0, 0, 0), "std": (1, 1, 1), "names": ("a", "b", "c"), "first_label": 0,
        "taken": None, "channels": 3, "row_boxes": True, "box_form": habits.box_form, "box_units": habits.box_units,
        "activation": habits.activation, "nms": habits.nms, "min_score": 0.25, "iou": 0.5, "max_boxes": 300,
    }  # fmt: skip
    return Recipe(**(values | changes))


def iou(a, b):
    wide = min(a[2], b[2]) - max(a[0], b[0])
    high = min(a[3], b[3]) - max(a[1], b[1])
    inside = max(wide, 0) * max(high, 0)
    return inside / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inside)


def suppress_slowly(boxes, scores, label, limit):
    """Greedy non-maximum suppression as it is defined."""
    kept = []
    for i in sorted(range(len(boxes)), key=lambda i: (-scores[i], i)):
        if all(label[i] != label[k] or iou(boxes[i], boxes[k]) <= limit for k in kept):
            kept.append(i)
    return kept


@example(347, 46, 0.0)  # boxes with negative coordinates
@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.sampled_from([0.0, 0.3, 0.5, 0.9, 1.0]))
def test_suppression_is_greedy_within_each_class(seed, count, limit):
    rng = np.random.default_rng(seed)
    corner = rng.uniform(-20, 100, (count, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(1, 80, (count, 2))], axis=1)
    scores = rng.permutation(np.linspace(0.1, 1, count)) if count else np.zeros(0)
    label = rng.integers(0, 3, count)
    assert suppress(boxes, scores, label, limit).tolist() == suppress_slowly(boxes, scores, label, limit)


def reference_grid(raw, width, height):
    """YOLOX's decoding cell by cell: x1, y1, x2, y2, score and class of each."""
    rows, i = [], 0
    for stride in (8, 16, 32):
        for y in range(height // stride):
            for x in range(width // stride):
                cx, cy, w, h, objectness, *classes = raw[i]
                cx, cy, w, h = (cx + x) * stride, (cy + y) * stride, np.exp(w) * stride, np.exp(h) * stride
                best = int(np.argmax(classes))
                rows.append((cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2, objectness * classes[best], best))
                i += 1
    assert i == len(raw)
    return np.array(rows)


def test_yolox_grid_on_an_input_that_is_not_square():
    rng = np.random.default_rng(0)
    raw = rng.normal(0, 0.7, (1680, 8)).astype(np.float32)
    raw[:, 4:] = rng.random((1680, 4))
    found = decode(recipe("yolox", nms=False, max_boxes=2000), {"predictions": raw}, 320, 256)
    truth = reference_grid(raw.astype(float), 320, 256)
    truth = truth[truth[:, 4] >= 0.25]
    truth = truth[np.argsort(-truth[:, 4], kind="stable")]
    assert len(truth) > 300
    np.testing.assert_allclose(found.boxes, truth[: len(found.boxes), :4], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(found.scores, truth[: len(found.boxes), 4], rtol=1e-5)
    assert len(found.boxes) == min(len(truth), 1000)
    with pytest.raises(DetectorError, match="1680 predictions, but the grids of an input of 320x320 have 2100"):
        decode(recipe("yolox"), {"predictions": raw}, 320, 320)


@pytest.mark.parametrize("activation", ["none", "sigmoid", "softmax"])
def test_scores_of_the_detr_family(activation):
    rng = np.random.default_rng(1)
    logits = rng.normal(0, 4, (200, 4)).astype(np.float32)
    logits = expit(logits) if activation == "none" else logits
    boxes = rng.uniform(0.2, 0.8, (200, 4)).astype(np.float32)
    scores = {"none": logits, "sigmoid": expit(logits), "softmax": softmax(logits, axis=1)[:, :3]}[activation]
    names = ("a", "b", "c", "d")[: scores.shape[1]]
    found = decode(
        recipe("detr", activation=activation, channels=4, names=names), {"boxes": boxes, "logits": logits}, 320, 256
    )
    best = scores.max(axis=1)
    order = np.argsort(-best, kind="stable")
    order = order[best[order] >= 0.25]
    np.testing.assert_allclose(found.scores, best[order], rtol=1e-5)
    assert found.label.tolist() == scores[order].argmax(axis=1).tolist()
    centre, half = boxes[order, :2] * [320, 256], boxes[order, 2:] * [160, 128]
    np.testing.assert_allclose(found.boxes, np.concatenate([centre - half, centre + half], axis=1), rtol=1e-5)


def test_yolov5_multiplies_objectness_and_class():
    rows = np.array(
        [[50, 50, 20, 20, 0.9, 0.1, 0.8, 0.2], [90, 90, 20, 20, 0.4, 0.9, 0, 0], [9, 9, 9, 9, 0.5, 0.5, 0.5, 0.4]],
        np.float32,
    )
    found = decode(recipe("yolov5"), {"predictions": rows}, 320, 256)
    np.testing.assert_allclose(found.scores, [0.72, 0.36, 0.25], rtol=1e-5)
    assert found.label.tolist() == [1, 0, 0]
    np.testing.assert_allclose(found.boxes[0], [40, 40, 60, 60])


def test_what_cannot_be_a_box_is_left_out():
    nan, inf = np.nan, np.inf
    rows = [
        [50, 50, 90, 90, 0.9, 0],
        [nan, 1, 2, 3, 0.9, 1],
        [1, 1, inf, 3, 0.9, 1],
        [5, 5, 5, 9, 0.9, 1],
        [9, 9, 4, 4, 0.9, 1],
    ]
    rows += [[1, 1, 9, 9, nan, 1], [1, 1, 9, 9, 0.9, nan], [1, 1, 9, 9, 0.9, -1]]
    found = decode(recipe("end_to_end"), {"predictions": np.array(rows, np.float32)}, 320, 256)
    assert found.boxes.tolist() == [[50, 50, 90, 90]]


@pytest.mark.parametrize("number", [0.5, 632.5, -19999.0])
@pytest.mark.parametrize("score", [0.0, 0.9])
def test_a_class_that_cannot_be_tells_that_the_layout_is_wrong_at_any_score(number, score):
    rows = np.array([[50, 50, 90, 90, 0.9, 0], [1, 1, 9, 9, score, number]], np.float32)
    with pytest.raises(DetectorError, match=f"class {number:g}, which is no number of a class") as refused:
        decode(recipe("end_to_end"), {"predictions": rows}, 320, 256)
    assert "detector.layout" in str(refused.value)


def test_units_are_told_by_the_values_where_they_are_not_known():
    outputs = {"labels": np.array([0, 1]), "scores": np.array([0.9, 0.8], np.float32)}
    for boxes, first in (
        ([[0.1, 0.25, 0.5, 0.75], [-0.1, 0, 1.1, 1]], [32, 64, 160, 192]),
        ([[1, 1, 9, 9], [0, 0, 1, 1]], [1, 1, 9, 9]),
    ):
        found = decode(recipe("ssd"), outputs | {"boxes": np.array(boxes, np.float32)}, 320, 256)
        np.testing.assert_allclose(found.boxes[0], first, rtol=1e-6)
    tiny = decode(
        recipe("ssd", box_units="pixels"), outputs | {"boxes": np.array([[0, 0, 1, 1.0], [0, 0, 0.5, 1]])}, 320, 256
    )
    assert tiny.boxes.max() == 1


sides = st.integers(1, 3000)


@given(sides, sides, st.sampled_from(["letterbox", "corner", "stretch"]), st.booleans(), st.booleans(), st.integers(0, 99))
@example(33, 1828, "letterbox", False, False, 0)
def test_boxes_go_in_and_come_back(width, height, resize, free_width, free_height, seed):
    size = InputSize(640, 416, free_width, free_height, 32)
    where = fit(recipe("yolov8", size=size, resize=resize), width, height)
    assert 0 <= where.left <= where.left + where.content_width <= where.input_width <= 640
    assert 0 <= where.top <= where.top + where.content_height <= where.input_height <= 416
    assert free_width or where.input_width == 640
    assert free_height or where.input_height == 416
    assert where.input_width % 32 == where.input_height % 32 == 0
    if resize == "stretch":
        assert (where.content_width, where.content_height) == (640, 416)
    else:
        assert where.content_width == 640 or where.content_height == 416
        scale = where.content_width / width, where.content_height / height
        # each side is rounded: what it was lies within half a pixel, and may be smaller than it is now
        rounded = 0.5 / (where.content_width - 0.5) + 0.5 / (where.content_height - 0.5)
        assert abs(scale[0] / scale[1] - 1) <= rounded + 1e-3 or min(width, height) < 9
    if resize == "letterbox":
        assert abs(2 * where.left + where.content_width - where.input_width) <= 1
        assert abs(2 * where.top + where.content_height - where.input_height) <= 1
    if resize == "corner":
        assert (where.left, where.top) == (0, 0)
    raw = np.random.default_rng(seed).uniform(0, 1, (5, 4)) * [width, height, width, height]
    scale = np.array([where.content_width / width, where.content_height / height] * 2)
    inside = raw * scale + np.array([where.left, where.top] * 2)
    np.testing.assert_allclose(where.to_raw(inside), raw, atol=1e-9 * max(width, height))


@given(arrays(np.uint8, (6, 8, 3)), st.sampled_from(["rgb", "bgr"]), st.integers(1, 3))
def test_values_are_those_of_the_definition(image, colour, count):
    mean, std = (0.1, 0.2, 0.3), (0.5, 0.6, 0.7)
    size = InputSize(8, 10, free_width=False, free_height=False, stride=1)
    how = recipe("yolov8", size=size, colour=colour, divide_by=200.0, mean=mean, std=std, pad=50)
    blob = fill(how, [image], fit(how, 8, 6), count)
    canvas = np.full((10, 8, 3), 50.0)
    canvas[2:8] = image[:, :, ::-1] if colour == "rgb" else image
    expected = ((canvas / 200 - mean) / std).transpose(2, 0, 1)
    assert blob.shape == (count, 3, 10, 8)
    assert blob.dtype == np.float32
    np.testing.assert_allclose(blob[0], expected, atol=1e-5)
    grey = ((50 / 200 - np.array(mean)) / std)[:, None, None]
    np.testing.assert_allclose(blob[1:], np.broadcast_to(grey, (count - 1, 3, 10, 8)), atol=1e-5)
