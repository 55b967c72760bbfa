"""Boxes of a part of a thing that has another box."""

from __future__ import annotations

import numpy as np
from more_boxes import left_parts, with_second_boxes

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.frontend.bearings import build_rays
from objslam.frontend.boxes.nested_boxes import PARTS, parts_of_boxes
from objslam.frontend.keyframes import build_keyframes
from objslam.simulation import preset, simulate

ZERO = np.zeros(2, dtype=np.int64)
WHOLE, PART = [100.0, 100.0, 200.0, 200.0], [100.0, 100.0, 160.0, 200.0]


def parts(boxes, scores=(0.9, 0.5), frame=ZERO, label=ZERO, cut=(False, False)):
    found = parts_of_boxes(np.array(boxes), frame, label, np.array(scores), np.array(cut))
    turned = parts_of_boxes(np.array(boxes)[::-1], frame[::-1], label[::-1], np.array(scores)[::-1], np.array(cut)[::-1])
    assert found.tolist() == turned[::-1].tolist()  # The order of the boxes has no effect.
    return found.tolist()


def test_the_surer_box_of_a_thing_counts():
    assert parts([WHOLE, PART]) == [False, True]
    assert parts([WHOLE, PART], scores=(0.5, 0.9)) == [True, False]
    assert parts([WHOLE, PART], scores=(0.9, 0.9)) == [False, True]  # the outer one


def test_a_part_of_a_cut_off_thing_does_not_count():
    assert parts([WHOLE, PART], scores=(0.5, 0.9), cut=(True, False)) == [False, True]


def test_boxes_of_two_things_stay():
    assert parts([WHOLE, PART], label=np.array([0, 1])) == [False, False]
    assert parts([WHOLE, PART], frame=np.array([0, 1])) == [False, False]
    assert parts([WHOLE, [150.0, 100.0, 240.0, 200.0]]) == [False, False]  # one hides a half of the other
    assert parts([WHOLE, [120.0, 120.0, 160.0, 160.0]]) == [False, False]  # a second thing far behind


def test_many_boxes_are_compared_with_each_other():
    """Against a loop over all pairs."""
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 60, (300, 2))
    boxes = np.hstack([low, low + rng.uniform(10, 90, (300, 2))])
    frame, label, scores, cut = rng.integers(0, 15, 300), rng.integers(0, 2, 300), rng.random(300), rng.random(300) < 0.3
    want = np.zeros(300, dtype=bool)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    for i in range(300):
        for j in range(300):
            if i == j or (frame[i], label[i]) != (frame[j], label[j]) or area[i] > area[j]:
                continue
            sides = np.minimum(boxes[i, 2:], boxes[j, 2:]) - np.maximum(boxes[i, :2], boxes[j, :2])
            if (sides > 0).all() and sides.prod() >= 0.9 * area[i] and area[i] >= 0.3 * area[j]:
                want[i if cut[j] or scores[i] < scores[j] else j] = True
    assert 10 < want.sum() < 200
    assert (parts_of_boxes(boxes, frame, label, scores, cut) == want).all()


def test_parts_give_no_rays_and_are_counted():
    log, ledger = simulate(preset("demo"), 0), Ledger()
    some = np.arange(0, len(log.cameras[0].detections), 5)
    changed = with_second_boxes(log, some, left_parts)
    settings = Settings()
    before = build_rays(log, build_keyframes(log, settings, Ledger()), settings, Ledger())
    after = build_rays(changed, build_keyframes(changed, settings, Ledger()), settings, ledger)
    np.testing.assert_array_equal(after.box, before.box)
    assert ledger.dropped[PARTS] == len(some)
