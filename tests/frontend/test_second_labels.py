"""Boxes that give the thing of another box a second label."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from more_boxes import with_boxes, with_second_labels

from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.boxes import second_labels
from objslam.frontend.boxes.second_labels import SECOND_LABELS, SecondLabelFinder, without_second_labels
from objslam.frontend.keyframes import build_keyframes
from objslam.simulation import PRESETS, preset, simulate

SETTINGS = Settings()
BOX = np.array([100.0, 100.0, 200.0, 200.0])


@pytest.fixture(scope="module")
def drive():
    return simulate(preset("demo"), 0)


def second_of_a_third(log):
    return with_second_labels(log, np.arange(0, len(log.cameras[0].detections), 3))


def dropped(log: Log, settings: Settings = SETTINGS) -> tuple[Detections, int]:
    ledger = Ledger()
    left = without_second_labels(log, settings, ledger).cameras[0].detections
    return left, ledger.dropped.get(SECOND_LABELS, 0)


def log_of(drive, first, second, scores=(0.9, 0.5)):
    """The log of a drive with boxes (F, 4) of two labels in its first frames instead of its own."""
    camera = drive.cameras[0]
    empty = replace(drive, cameras=(replace(camera, detections=camera.detections.take(np.zeros(0, dtype=np.int64))),))
    frames = np.arange(len(first))
    log = with_boxes(with_boxes(empty, frames, first, "cup"), frames, second, "bottle")
    found = log.cameras[0].detections
    cups = found.label == found.label_names.index("cup")
    found = replace(found, scores=np.where(cups, *scores))
    return replace(log, cameras=(replace(camera, detections=found),))


def crossing(count):
    """Boxes (count, 4) that pass a box at rest sideways, each with the place of the box at rest on its way."""
    at_rest = BOX + 3.0 * np.arange(count)[:, None]
    return at_rest, at_rest + np.linspace(-100, 100, count)[:, None] * np.array([1.0, 0.0, 1.0, 0.0])


def test_second_labels_are_dropped_counted_and_kept_as_labels(drive):
    log, ledger, own = second_of_a_third(drive), Ledger(), drive.cameras[0].detections
    less = without_second_labels(log, SETTINGS, ledger)
    found = less.cameras[0].detections
    count = len(log.cameras[0].detections) - len(own)
    assert count > 100
    assert ledger.dropped == {SECOND_LABELS: count}
    assert ledger.totals == {SECOND_LABELS: len(own) + count}
    name, number = ledger.examples[SECOND_LABELS][0].split(" on ")[1].split(",")
    assert ledger.examples[SECOND_LABELS][0].startswith(f"like {name} on {name}, ")
    assert count / 5 < int(number.split()[0]) <= count  # The most frequent pair of labels comes first.
    np.testing.assert_array_equal(found.boxes, own.boxes)
    marked = np.flatnonzero(found.second >= 0)
    np.testing.assert_array_equal(marked, np.arange(0, len(own), 3))
    assert [found.label_names[i] for i in found.second[marked]] == [f"like {own.labels[i]}" for i in marked]
    rays = build_rays(less, build_keyframes(less, SETTINGS, Ledger()), SETTINGS, Ledger())
    seconds = rays.second >= 0
    assert len(rays) / 4 < seconds.sum() < len(rays) / 2
    expected = ["like " + rays.label_names[i] for i in rays.label[seconds]]
    assert [rays.label_names[i] for i in rays.second[seconds]] == expected


def test_a_setting_keeps_them(drive):
    log = second_of_a_third(drive)
    assert without_second_labels(log, load_settings(None, ("rays.second_labels=false",)), Ledger()) is log


def test_boxes_without_a_size_and_fiducials_stay(drive):
    log = second_of_a_third(drive)
    camera = log.cameras[0]
    found = camera.detections
    tags = replace(found, corners=np.tile(found.boxes[:, None, :2], (1, 4, 1)))
    bearings = replace(camera, camera=replace(camera.camera, sees_size=False))
    whole = replace(camera, detections=replace(found, whole=True))
    for one in (bearings, whole, replace(camera, detections=tags)):
        assert dropped(replace(log, cameras=(one,)))[1] == 0


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_no_box_of_a_clean_drive_is_dropped(name):
    for seed in range(3):
        log = simulate(preset(name), seed)
        assert without_second_labels(log, SETTINGS, Ledger()) is log


def test_the_surer_box_stays(drive):
    boxes = BOX + 5.0 * np.arange(20)[:, None]
    for scores, stays in ((0.9, 0.5), "cup"), ((0.5, 0.9), "bottle"):
        left, count = dropped(log_of(drive, boxes, boxes + 1.0, scores))
        assert count == 20
        assert set(left.labels) == {stays}


def test_things_that_pass_each_other_stay_two(drive):
    log = log_of(drive, *crossing(60))
    assert dropped(log)[1] == 0


def test_a_robot_that_waits_before_two_things_shows_them_once(drive):
    first, second = crossing(40)
    rng = np.random.default_rng(0)
    waiting = np.repeat(BOX[None], 50, axis=0)
    jitter = rng.normal(0, 0.5, (2, 50, 4))
    both = np.concatenate([first, waiting + jitter[0]]), np.concatenate([second, waiting + 2.0 + jitter[1]])
    assert dropped(log_of(drive, *both))[1] == 0


def test_few_boxes_are_second_labels_if_the_detector_gives_others(drive):
    boxes = BOX + 5.0 * np.arange(3)[:, None]
    few = log_of(drive, boxes, boxes + 1.0)
    assert dropped(few)[1] == 0
    more = BOX + 5.0 * np.arange(30)[:, None]
    frames = np.arange(10, 40)
    others = with_boxes(with_boxes(few, frames, more, "tv"), frames, more, "laptop")
    assert dropped(others)[1] == 33


def test_a_third_label_goes_too(drive):
    boxes = BOX + 5.0 * np.arange(20)[:, None]
    left, count = dropped(with_boxes(log_of(drive, boxes, boxes, (1.0, 0.5)), np.arange(20), boxes, "vase"))
    assert count == 40
    assert set(left.labels) == {"cup"}


def test_a_session_learns_what_a_log_shows(drive):
    log = second_of_a_third(drive)
    found = log.cameras[0].detections
    finder, gone = SecondLabelFinder(), []
    for frame in range(len(found.frame_stamps)):
        mine = np.flatnonzero(found.frame == frame)
        second, below = finder.add(0, found.boxes[mine], found.label[mine], found.scores[mine])
        gone.extend(mine[second].tolist())
        assert (found.scores[mine[below]] > found.scores[mine[second]]).all()
    later, _ = finder.second_boxes(found.boxes, found.frame, found.label, found.scores)
    assert (np.char.startswith(np.array(found.labels)[later], "like ")).all()
    assert len(later) == len(found) - len(drive.cameras[0].detections)
    assert 0.9 * len(later) < len(gone) <= len(later)
    assert set(gone) <= set(later.tolist())


def test_a_frame_whose_boxes_are_apart_takes_no_search_and_changes_nothing(monkeypatch):
    """Against the search in every frame, for boxes of which some lie on each other."""
    search, calls, rng = second_labels.pairs_on_each_other, [], np.random.default_rng(2)
    monkeypatch.setattr(second_labels, "pairs_on_each_other", lambda *boxes: (calls.append(1), search(*boxes))[1])
    quick, full = SecondLabelFinder(), SecondLabelFinder()
    for _ in range(200):
        at, label, score = rng.uniform(0, 400, (6, 2)), rng.integers(0, 3, 6), rng.uniform(0.3, 1.0, 6)
        frame = np.hstack([at, at + rng.uniform(20, 200, (6, 2))]), label, score
        before = len(calls)
        found = quick.add(0, *frame)
        searched = len(calls) > before
        with monkeypatch.context() as patch:
            patch.setattr(second_labels, "_lie_on_each_other", lambda *_: True)
            expected = full.add(0, *frame)
        assert [one.tolist() for one in found] == [one.tolist() for one in expected]
        assert searched == bool(len(search(frame[0], np.zeros(6, dtype=int), label, score).first))
    assert quick == full
    assert full._near.total() > 20
    assert 200 < len(calls) < 400


def test_the_memory_of_a_crowded_frame_grows_with_its_boxes():
    """All pairs of 4,000 boxes would take 128 MB for each number of a pair."""
    rng = np.random.default_rng(3)
    at, label = rng.uniform(0, 4000, (4000, 2)), rng.integers(0, 3, 4000)
    boxes = np.hstack([at, at + rng.uniform(5, 50, (4000, 2))])
    tracemalloc.start()
    SecondLabelFinder().add(0, boxes, label, rng.uniform(0.3, 1.0, 4000))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 30e6


def test_a_frame_without_a_box_has_no_second_labels():
    none = np.zeros(0, dtype=np.int64)
    assert [len(one) for one in SecondLabelFinder().add(0, np.zeros((0, 4)), none, np.zeros(0))] == [0, 0]
