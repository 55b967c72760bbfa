"""Labels in a picture: in the frame, over no other label, over no dot, near their own."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from objslam.output.plot.label_layout import needs_leader, place_labels

FRAME = np.array([[100.0, 50.0], [1000.0, 900.0]])
NO_POINTS = np.zeros((0, 2))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Area (px^2) that two boxes x1, y1, x2, y2 share."""
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    return float(max(width, 0) * max(height, 0))


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from([15.0, 80.0, 400.0]))
def test_no_label_covers_another_or_a_dot(seed: int, count: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    anchors = np.clip(rng.normal([500, 450], spread, size=(count, 2)), FRAME[0] + 5, FRAME[1] - 5)
    sizes = np.column_stack([rng.uniform(20, 110, count), np.full(count, 14.0)])
    corners, found = place_labels(anchors, sizes, FRAME, rng.uniform(FRAME[0], FRAME[1], size=(300, 2)))
    boxes = np.concatenate([corners, corners + sizes], axis=1)[found]
    assert (boxes[:, :2] >= FRAME[0]).all()
    assert (boxes[:, 2:] <= FRAME[1]).all()
    for i, box in enumerate(boxes):
        assert all(overlap(box, other) == 0 for other in boxes[:i])
        assert not ((box[:2] < anchors) & (anchors < box[2:])).all(axis=1).any()


def test_every_label_of_fifteen_in_clusters_finds_room_near_its_dot() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[200, 150], [800, 200], [500, 800], [250, 600], [900, 600.0]])
    anchors = (centres[:, None] + rng.uniform(-12, 12, size=(5, 3, 2))).reshape(-1, 2)
    sizes = np.tile([80.0, 14.0], (15, 1))
    corners, found = place_labels(anchors, sizes, FRAME, NO_POINTS)
    assert found.all()
    off = np.linalg.norm(np.clip(anchors, corners, corners + sizes) - anchors, axis=1)
    assert off.max() < 60


def test_a_lone_label_stands_right_beside_its_dot() -> None:
    size = np.array([[60.0, 14.0]])
    corners, found = place_labels(np.array([[500.0, 400.0]]), size, FRAME, NO_POINTS)
    assert found[0]
    np.testing.assert_allclose(corners[0], [509.0, 393.0])
    at_the_edge, _ = place_labels(np.array([[990.0, 400.0]]), size, FRAME, NO_POINTS)
    np.testing.assert_allclose(at_the_edge[0], [921.0, 393.0])


def test_a_label_keeps_off_the_path() -> None:
    line = np.column_stack([np.linspace(500, 900, 200), np.full(200, 400.0)])
    corners, _ = place_labels(np.array([[500.0, 400.0]]), np.array([[60.0, 14.0]]), FRAME, line)
    box = np.concatenate([corners[0], corners[0] + [60, 14]])
    assert not ((box[:2] <= line) & (line <= box[2:])).all(axis=1).any()


def test_what_finds_no_room_is_said() -> None:
    tight = np.array([[0.0, 0.0], [50.0, 50.0]])
    _, found = place_labels(np.full((1, 2), 25.0), np.array([[60.0, 14.0]]), tight, NO_POINTS)
    assert not found.any()
    corners, found = place_labels(NO_POINTS, NO_POINTS, tight, NO_POINTS)
    assert corners.shape == (0, 2)
    assert found.shape == (0,)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_a_label_nearer_to_anothers_dot_has_a_line(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    anchors = rng.normal([500, 450], 25.0, size=(count, 2))
    sizes = np.tile([70.0, 14.0], (count, 1))
    corners, _ = place_labels(anchors, sizes, FRAME, NO_POINTS)
    led = needs_leader(anchors, corners, sizes)
    for j in range(count):
        off = np.linalg.norm(np.clip(anchors, corners[j], corners[j] + sizes[j]) - anchors, axis=1)
        assert led[j] or off[j] < np.delete(off, j).min()


def test_two_close_dots_have_their_labels_on_their_own_sides() -> None:
    anchors = np.array([[500.0, 400.0], [510.0, 418.0]])
    sizes = np.tile([80.0, 14.0], (2, 1))
    corners, found = place_labels(anchors, sizes, FRAME, NO_POINTS)
    assert found.all()
    for j in range(2):
        off = np.linalg.norm(np.clip(anchors, corners[j], corners[j] + sizes[j]) - anchors, axis=1)
        assert off[j] < off[1 - j]
