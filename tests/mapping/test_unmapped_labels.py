"""A label that was seen, but has no object, is named with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from doubtful_drives import LEAN, mapped

from objslam.core.result import Doubt, RunResult
from objslam.core.types import Log
from objslam.simulation import preset, simulate


def drive() -> Log:
    """Of five things, each with a label of its own, all boxes of the first are cut off, and two boxes of the second are
    whole. The boxes of the third are those of a few frames that follow each other, and the fourth has two boxes at all."""
    log = simulate(preset("demo", objects=5, classes=5, false=0.0, missed=0.0, tracks="perfect", odometry=None), 1)
    (camera,) = log.cameras
    found = camera.detections
    rows = [np.flatnonzero(found.label == i) for i in range(5)]
    boxes, left = found.boxes.copy(), np.ones(len(found), dtype=bool)
    whole = (boxes[:, :2] > 60).all(axis=1) & (boxes[:, 2:] < camera.camera.size - 61).all(axis=1)
    boxes[rows[0], 0] = 0.0
    boxes[np.setdiff1d(rows[1], rows[1][whole[rows[1]]][:2]), 0] = 0.0
    run = rows[2][whole[rows[2]]][:6]
    left[np.setdiff1d(rows[2], run)] = False
    boxes[run] = boxes[run[0]]
    left[rows[3][2:]] = False
    changed = replace(found, boxes=boxes, track_ids=np.full(len(found), -1)).take(left)
    return replace(log, cameras=(replace(camera, detections=changed),))


def named(result: RunResult) -> dict[str, str]:
    return {one.label: one.reason for one in result.doubts if one.kind == "label"}


def test_labels_without_an_object_are_named_with_the_reason() -> None:
    log = drive()
    names = log.cameras[0].detections.label_names
    result = mapped(log, LEAN)
    have = {o.label for o in result.map.objects}
    assert names[4] in have
    found = named(result)
    assert found[names[0]] == "cut off"
    assert found[names[1]] == "few"
    assert names[3] not in found  # Two frames are too few to be named.
    told = {one.label for one in result.doubts if one.kind == "boxes"}
    lost = {name for name in names if name not in have} - {names[3]}
    assert lost == {*names[:3]}
    assert set(found) == lost - told
    assert result.summary["doubts"]["label"] == len(found)
    reasons = result.summary["assessment"]["reasons"]
    cut = np.sum(log.cameras[0].detections.label == 0)
    (said,) = [reason for reason in reasons if repr(names[0]) in reason]
    assert f"cuts off all of its {cut} boxes" in said
    assert len([reason for reason in reasons if reason.startswith("No object has the label")]) == len(lost)


def few_boxes(number: int) -> Log:
    """Of eight things at rest, the third has some boxes in images that follow each other, under little parallax."""
    log = simulate(preset("demo", objects=8, classes=8, false=0.0, missed=0.0, tracks="perfect", odometry=None), 2)
    (camera,) = log.cameras
    found = camera.detections
    mine = np.flatnonzero(found.track_ids == 2)
    whole = (found.boxes[mine, :2] > 60).all(axis=1) & (found.boxes[mine, 2:] < camera.camera.size - 61).all(axis=1)
    left = np.ones(len(found), dtype=bool)
    left[np.setdiff1d(mine, mine[whole][10 : 10 + number])] = False
    changed = replace(found, track_ids=np.full(len(found), -1)).take(left)
    return replace(log, cameras=(replace(camera, detections=changed),))


@pytest.mark.parametrize("number", [8, 12])
def test_a_thing_at_rest_with_few_rays_is_not_said_to_move(number: int) -> None:
    log = few_boxes(number)
    result = mapped(log, LEAN)
    (doubt,) = [one for one in result.doubts if one.kind == "label"]
    truth = log.truth.objects[2]
    assert doubt.label == truth.label
    assert doubt.reason == "rare"
    assert f"only {number} of " in doubt.text
    assert not any(word in doubt.text for word in ("at rest", "moves"))
    assert doubt.position is not None
    assert np.linalg.norm(doubt.position - truth.position) < 0.2


def with_one_cut_off(classes: int, frames: slice = slice(None)) -> Log:
    """A drive past eight things. Of the third, all boxes end at the image's upper edge, and only some are there."""
    log = simulate(preset("demo", objects=8, classes=classes, false=0.0, missed=0.0, tracks="perfect", odometry=None), 1)
    (camera,) = log.cameras
    found = camera.detections
    mine = np.flatnonzero(found.track_ids == 2)
    boxes, left = found.boxes.copy(), np.ones(len(found), dtype=bool)
    boxes[mine, 1] = 0.0
    left[np.setdiff1d(mine, mine[frames])] = False
    changed = replace(found, boxes=boxes, track_ids=np.full(len(found), -1)).take(left)
    return replace(log, cameras=(replace(camera, detections=changed),))


def cut_off(result: RunResult) -> list[Doubt]:
    return [one for one in result.doubts if one.reason == "cut off"]


def test_a_thing_with_cut_off_boxes_only_is_named_with_its_place_beside_others_of_its_label() -> None:
    log = with_one_cut_off(classes=3)
    result, truth = mapped(log, LEAN), log.truth.objects[2]
    assert truth.label in {o.label for o in result.map}
    (doubt,) = cut_off(result)
    assert (doubt.kind, doubt.label) == ("boxes", truth.label)
    # The heights of the boxes are wrong, because they were cut by hand. Their sides are right.
    assert np.linalg.norm(doubt.position[:2] - truth.position[:2]) < 0.3
    assert f"{doubt.numbers['boxes_cut_off']} {truth.label} boxes" in doubt.text
    assert result.summary["doubts"]["boxes"] == 1
    assert [repr(truth.label) in reason for reason in result.summary["assessment"]["reasons"]] == [False, True]
    assert result.summary["assessment"]["level"] == "good"
    assert result.summary["cut_off"] == {truth.label: sum(result.summary["dropped"].values())}


def test_a_label_with_cut_off_boxes_only_has_a_place_too() -> None:
    log = with_one_cut_off(classes=8)
    (doubt,) = cut_off(mapped(log, LEAN))
    truth = log.truth.objects[2]
    assert (doubt.kind, doubt.label) == ("label", truth.label)
    assert np.linalg.norm(doubt.position[:2] - truth.position[:2]) < 0.3


def test_cut_off_boxes_of_objects_and_those_of_a_few_frames_are_no_thing() -> None:
    assert cut_off(mapped(with_one_cut_off(classes=3, frames=slice(0, 4)), LEAN)) == []
    assert cut_off(mapped(simulate(preset("hard", odometry=None), 1), LEAN)) == []


def test_a_map_with_all_labels_names_none() -> None:
    result = mapped(simulate(preset("demo", objects=5, classes=5, false=0.0), 1), LEAN)
    assert named(result) == {}
    assert not any("No object has the label" in reason for reason in result.summary["assessment"]["reasons"])
