"""A label that was seen, but has no object, is named with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from doubtful_drives import LEAN, mapped

from objslam.core.result import RunResult
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


def test_a_map_with_all_labels_names_none() -> None:
    result = mapped(simulate(preset("demo", objects=5, classes=5, false=0.0), 1), LEAN)
    assert named(result) == {}
    assert not any("No object has the label" in reason for reason in result.summary["assessment"]["reasons"])
