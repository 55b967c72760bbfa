"""Edges of boxes along which another box begins, against a drawing of both."""

import numpy as np
import pytest

from objslam.core.bodies import covered_edges
from objslam.core.bodies.covered_edges import covered_shares, pairs_in_images


@pytest.mark.parametrize("at_once", [1, 7, 1000])
def test_pairs_are_all_pairs_of_an_image(at_once, monkeypatch):
    monkeypatch.setattr(covered_edges, "_PAIRS_AT_ONCE", at_once)
    image = np.random.default_rng(0).integers(0, 6, 25)
    blocks = list(pairs_in_images(image))
    found = sorted(pair for block in blocks for pair in zip(*(part.tolist() for part in block), strict=True))
    assert found == [(i, j) for i in range(25) for j in range(25) if i != j and image[i] == image[j]]
    assert max(len(first) for first, _ in blocks) <= 2 * (at_once + 24)
    assert not list(pairs_in_images(np.zeros(0, dtype=int)))
    assert not list(pairs_in_images(np.arange(5)))


@pytest.mark.parametrize("seed", range(3))
def test_edges_of_visible_parts_are_covered(seed):
    """Rectangles and ellipses are drawn in front of rectangles. Nearly each edge of the box of the visible part that is not
    that of the whole rectangle is covered. So are some others, along a part of which the thing in front begins."""
    rng, right, wrong, missed, total = np.random.default_rng(seed), 0, 0, 0, 0
    rows, columns = np.mgrid[0:120, 0:160]
    for _ in range(300):
        low = rng.integers(10, 70, 2)
        whole = np.concatenate([low, low + rng.integers(20, 60, 2)])
        middle, half = rng.integers(20, 100, 2), rng.integers(12, 40, 2)
        back = (columns >= whole[0]) & (columns < whole[2]) & (rows >= whole[1]) & (rows < whole[3])
        across, down = (columns + 0.5 - middle[0]) / half[0], (rows + 0.5 - middle[1]) / half[1]
        front = across**2 + down**2 < 1 if rng.random() < 0.5 else np.maximum(abs(across), abs(down)) < 1
        shown = back & ~front
        if shown.sum() < 0.3 * back.sum() or not (back & front).any():
            continue
        x, y = np.flatnonzero(shown.any(axis=0)), np.flatnonzero(shown.any(axis=1))
        box = np.array([x[0], y[0], x[-1] + 1, y[-1] + 1])
        other = np.concatenate([middle - half, middle + half])
        share = covered_shares(box[None].astype(float), other[None].astype(float), np.array([1.5]))[0]
        hidden = np.abs(box - whole) > 2
        right += (hidden & (share > 0.1)).sum()
        missed += (hidden & (share <= 0.1)).sum()
        wrong += (~hidden & (share > 0.1)).sum()
        total += (~hidden).sum()
    assert right > 30
    assert missed < 0.2 * right
    assert wrong < 0.3 * total


def test_a_box_within_another_is_not_behind_it():
    inner, outer, noise = np.array([[40.0, 40, 60, 60]]), np.array([[30.0, 30, 130, 130]]), np.array([2.0])
    assert not covered_shares(inner, outer, noise).any()
    beside = np.array([[10.0, 40, 30, 60]])
    np.testing.assert_array_equal(covered_shares(beside, outer, noise), [[0, 0, 1, 0]])


def test_two_boxes_together_cover_an_edge():
    box, noise = np.tile([10.0, 10, 50, 90], (2, 1)), np.full(2, 2.0)
    front = np.array([[50.0, 0, 90, 30], [50.0, 60, 90, 99]])  # They cover 20 and 30 px of the right edge.
    np.testing.assert_allclose(covered_shares(box, front, noise)[:, 2], [20 / 80, 30 / 80])
