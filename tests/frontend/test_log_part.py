"""A part of a log, against the whole log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from objslam.core.types import Images
from objslam.errors import LogError
from objslam.frontend.log_part import part_of_log
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def log():
    whole = simulate(preset("rooms"), 0)
    (camera,), path = whole.cameras, whole.robot_path
    stamps = camera.detections.frame_stamps
    images = Images(stamps, tuple(Path(f"{i}.png") for i in range(len(stamps))))
    steps = np.arange(3.0 * len(path)).reshape(-1, 3)
    localization = replace(path, travel=steps)
    return replace(whole, cameras=(replace(camera, rgb=images, mount=path),), localization=localization, odometry=path)


def test_two_parts_are_the_whole(log):
    middle = float(np.median(log.localization.stamps))
    first, second = part_of_log(log, None, middle), part_of_log(log, middle, None)
    assert first.localization.stamps[-1] < middle <= second.localization.stamps[0]
    for name in ("localization", "odometry"):
        parts = [getattr(one, name) for one in (first, second)]
        np.testing.assert_array_equal(np.concatenate([p.stamps for p in parts]), getattr(log, name).stamps)
        np.testing.assert_array_equal(np.concatenate([p.poses for p in parts]), getattr(log, name).poses)
    np.testing.assert_array_equal(np.concatenate([p.localization.travel for p in (first, second)]), log.localization.travel)
    whole = log.cameras[0]
    parts = [one.cameras[0] for one in (first, second)]
    for name in ("stamps", "boxes", "label", "scores", "depths", "track_ids"):
        both = np.concatenate([getattr(p.detections, name) for p in parts])
        np.testing.assert_array_equal(both, getattr(whole.detections, name))
    np.testing.assert_array_equal(np.concatenate([p.detections.frame_stamps for p in parts]), whole.detections.frame_stamps)
    assert parts[0].rgb.paths + parts[1].rgb.paths == whole.rgb.paths
    np.testing.assert_array_equal(np.concatenate([p.mount.stamps for p in parts]), whole.mount.stamps)
    assert first.truth.objects == log.truth.objects


def test_no_limit_is_the_whole_log(log):
    same = part_of_log(log, None, None)
    np.testing.assert_array_equal(same.localization.poses, log.localization.poses)
    assert len(same.cameras[0].detections) == len(log.cameras[0].detections)


def test_a_part_without_poses_or_boxes_is_one_clear_error(log):
    late = log.localization.stamps[-1] + 100
    with pytest.raises(LogError, match=r"no pose lies in .* from .* to .* s") as caught:
        part_of_log(log, late, None)
    assert "--begin" in str(caught.value)
    (camera,), path = log.cameras, log.localization
    longer = replace(path, stamps=np.append(path.stamps, late + 1), poses=path.poses[[*range(len(path)), -1]], travel=None)
    on = replace(log, localization=longer)
    with pytest.raises(LogError, match="no pose of the camera front lies"):
        part_of_log(on, late, None)
    with pytest.raises(LogError, match="no detection frame lies"):
        part_of_log(replace(on, cameras=(replace(camera, mount=None),)), late, None)
