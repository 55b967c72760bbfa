"""Rays from one place meet with any mount of the camera. So they must not hide that the mount is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Log
from objslam.mapping.checks.diagnosis import diagnose
from objslam.mapping.checks.hypotheses.hypothesis import with_cameras
from objslam.mapping.standstills import repeated_views
from objslam.simulation import PoseNoise, preset, simulate


def drive(frames: int, false: float = 0.01) -> Log:
    room = {"objects": 10, "classes": 10, "pixel_sigma": 2.0, "missed": 0.1, "false": false, "frames": frames}
    return simulate(preset("demo", **room, odometry=None, localization=PoseNoise(xy=0.02, yaw=0.005)), 3)


def waiting(log: Log, seconds: float, jitter: float, seed: int = 0) -> Log:
    """The log of a robot that stops in the last third of its drive, where it sees most boxes, and stands for some seconds.

    jitter: the noise (m) of its localisation while it stands.
    """
    rng = np.random.default_rng(seed)
    path, found = log.localization, log.cameras[0].detections
    boxes = np.bincount(found.frame, minlength=len(found.frame_stamps))
    at = 2 * len(boxes) // 3 + int(boxes[2 * len(boxes) // 3 :].argmax())
    stop, mine = found.frame_stamps[at], np.flatnonzero(found.frame == at)
    number = int(seconds / 0.1)
    stamps, frames = stop + 0.1 * np.arange(1, number + 1), np.arange(at + 1, at + 1 + number)
    before = found.take(found.frame <= at)
    more = found.take(np.tile(mine, number))
    shaken = more.boxes + rng.normal(scale=2.0, size=more.boxes.shape)
    every = replace(
        found.take(np.concatenate([np.flatnonzero(found.frame <= at), np.tile(mine, number)])),
        boxes=np.concatenate([before.boxes, shaken]),
        frame=np.concatenate([before.frame, np.repeat(frames, len(mine))]),
        frame_stamps=np.concatenate([found.frame_stamps[: at + 1], stamps]),
    )
    driven = path.stamps <= stop
    stands = np.repeat(path.poses[driven][-1:], number, axis=0)
    stands[:, :2, 3] += rng.normal(scale=jitter, size=(number, 2))
    whole = Trajectory(np.concatenate([path.stamps[driven], stamps]), np.concatenate([path.poses[driven], stands]))
    return replace(with_cameras(log, lambda one: replace(one, detections=every)), localization=whole)


def turned(log: Log) -> Log:
    """The log with a camera that is turned by 45 degrees about no axis."""

    def mounted(one: CameraLog) -> CameraLog:
        pose = one.camera.base_T_camera.copy()
        pose[:3, :3] = Rotation.from_euler("xyz", (40, 35, 45), degrees=True).as_matrix() @ pose[:3, :3]
        return replace(one, camera=replace(one.camera, base_T_camera=pose))

    return with_cameras(log, mounted)


def accused(log: Log) -> bool:
    return any(one.spoils for one in diagnose(log, load_settings(None, ("mode=fixed",)), Ledger()).findings)


@pytest.mark.parametrize("seconds", [0.0, 60.0, 240.0])
def test_a_wrong_mount_is_named_though_the_robot_stands_for_long(seconds):
    assert accused(turned(waiting(drive(300), seconds, 0.005)))


@pytest.mark.parametrize("seconds", [0.0, 240.0])
def test_a_robot_that_stands_for_long_is_not_accused(seconds):
    assert not accused(waiting(drive(300), seconds, 0.005))


def test_a_standstill_counts_once_if_each_path_stands():
    log = waiting(drive(300), 30.0, 0.005)
    stamps = log.cameras[0].detections.frame_stamps
    settings = load_settings(None, ())
    repeated = repeated_views(log, stamps, settings)
    begin = int(np.flatnonzero(repeated)[0])
    assert repeated[begin:].all()
    assert not repeated[:begin].any()
    assert stamps[begin] - stamps[begin - 1] < 1
    moving = Trajectory(log.localization.stamps, log.localization.poses.copy())
    moving.poses[:, 0, 3] = 0.1 * moving.stamps
    assert not repeated_views(replace(log, odometry=moving), stamps, settings).any()
    assert not repeated_views(replace(log, localization=None), stamps, settings).any()
