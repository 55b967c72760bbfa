"""A second thing of a label with a tenth of its boxes: the verdict names the label, and false boxes do not raise it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from doubtful_drives import LEAN, mapped

from objslam.config import Settings
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.mapping.doubts.evidence import evidence_of
from objslam.mapping.doubts.find import _of_lost_things
from objslam.mapping.doubts.groups import find_groups
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")
HELD = LEAN.model_copy(update={"calibration": LEAN.calibration.model_copy(update={"use": False})})
BY_LABEL = HELD.model_copy(update={"association": HELD.association.model_copy(update={"method": "by_label"})})


def mugs(*, absolute: bool, scattered: bool = False, share: float = 0.12, false: float = 0.0) -> Log:
    """A drive with 12 things, of which two are mugs. The second has a share of the boxes of mugs, in the images that are
    drawn at random. scattered: its boxes lie anywhere in these images."""
    poses = {"odometry": None} if absolute else {"localization": None}
    frames = 400 if absolute else 260
    log = simulate(preset("demo", objects=12, classes=12, tracks="perfect", frames=frames, false=false, **poses), 1)
    (camera,), rng = log.cameras, np.random.default_rng(1)
    found = camera.detections
    number = np.bincount(found.track_ids[found.track_ids >= 0], minlength=12)
    first, second = np.argsort(-number)[:2]
    theirs = np.flatnonzero(found.track_ids == second)
    kept = rng.choice(theirs, round(share * number[first] / (1 - share)), replace=False)
    mug = found.label[found.track_ids == first][0]
    label, boxes = np.where(found.track_ids == second, mug, found.label), found.boxes.copy()
    if scattered:
        size = boxes[kept, 2:] - boxes[kept, :2]
        corner = rng.random(size.shape) * (camera.camera.size - 1 - size)
        boxes[kept] = np.hstack([corner, corner + size])
    names = tuple("mug" if i == mug else name for i, name in enumerate(found.label_names))
    changed = replace(found, label=label, boxes=boxes, label_names=names, track_ids=np.full(len(label), -1))
    left = np.ones(len(label), dtype=bool)
    left[np.setdiff1d(theirs, kept)] = False
    return replace(log, cameras=(replace(camera, detections=changed.take(left)),))


@cache
def with_mugs(*, absolute: bool, by_label: bool = False) -> RunResult:
    return mapped(mugs(absolute=absolute), BY_LABEL if by_label else HELD)


def lost(result: RunResult) -> list[str]:
    return [reason for reason in result.summary["assessment"]["reasons"] if "fit no object, but meet in one place" in reason]


@pytest.mark.parametrize(("absolute", "by_label"), [(False, False), (True, False), (True, True)])
def test_a_second_thing_of_a_label_is_in_the_map_or_in_the_verdict(absolute: bool, by_label: bool) -> None:
    result = with_mugs(absolute=absolute, by_label=by_label)
    if sum(item.label == "mug" for item in result.map.resolved()) < 2:
        (reason,) = lost(result)
        assert "boxes of 'mug'" in reason
        assert result.summary["assessment"]["level"] == "check"


@pytest.mark.parametrize(("absolute", "settings"), [(False, HELD), (True, BY_LABEL)])
def test_boxes_that_scatter_are_no_second_thing(absolute: bool, settings: Settings) -> None:
    assert lost(mapped(mugs(absolute=absolute, scattered=True), settings)) == []
    assert lost(mapped(mugs(absolute=absolute, share=0.0, false=0.1), settings)) == []


@pytest.mark.parametrize(("views", "said"), [(2, False), (3, True)])
def test_rare_boxes_count_from_three_views_on(views: int, said: bool) -> None:
    """A detector repeats a false box while its view stays the same, and two views cross somewhere in any case."""
    result = with_mugs(absolute=True)
    groups = find_groups(evidence_of(result), result.settings)
    (mug,) = np.flatnonzero(groups.label == result.rays.label_names.index("mug"))
    assert len(_of_lost_things(groups, result)) == 1
    azimuth = np.degrees(np.arctan2(*result.directions[groups.ray][:, 1::-1].T))
    two_views = ((azimuth > -22) & (azimuth < -15)) | ((azimuth > 22) & (azimuth < 30))
    kept = np.flatnonzero((groups.group == mug) & (two_views | (azimuth < 17 if views == 3 else two_views)))
    assert len(kept) >= 8
    changed = replace(groups, ray=groups.ray[kept], group=groups.group[kept])
    assert bool(_of_lost_things(changed, result)) == said


@pytest.mark.parametrize(("others", "said"), [(5, True), (25, False)])
def test_a_stop_of_a_thing_that_moves_is_no_lost_thing(others: int, said: bool) -> None:
    """A label without an object has 11 boxes that meet at one place, and `others` that do not."""
    result = with_mugs(absolute=True)
    groups = find_groups(evidence_of(result), result.settings)
    mug = result.rays.label_names.index("mug")
    others_of_mug = np.setdiff1d(np.flatnonzero(result.rays.label == mug), groups.ray)
    label = result.rays.label.copy()
    label[others_of_mug[others:]] = (mug + 1) % 12
    objects = tuple(item for item in result.map.objects if item.label != "mug")
    changed = replace(result, rays=replace(result.rays, label=label), map=replace(result.map, objects=objects))
    assert (label == mug).sum() == 11 + others
    assert bool(_of_lost_things(groups, changed)) == said
