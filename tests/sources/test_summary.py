"""What is said of a log: its streams by closed form, and what a run would miss."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from objslam.core.trajectory import Trajectory
from objslam.core.types import Images
from objslam.simulation import preset, simulate
from objslam.sources.summary import contents, path_length, timing


@pytest.fixture(scope="module")
def log():
    return simulate(preset("demo"), 0)


def test_timing_of_stamps_in_any_order():
    found = timing(np.array([3.0, 1.0, 1.5, 7.0, 2.0]))
    assert (found.count, found.start, found.end, found.rate, found.longest_gap) == (5, 1.0, 7.0, 4 / 6, 4.0)
    assert (timing(np.array([5.0])).rate, timing(np.array([5.0])).longest_gap) == (0.0, 0.0)


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.03])
def test_the_length_of_a_path_is_without_its_noise(sigma):
    """A quarter of a circle of 4 m, a stop of 30 s, and 5 m straight on, at 20 Hz and 0.3 m/s, with jitter as of amcl."""
    angle = np.arange(0, np.pi / 2, 0.015 / 4)
    turn = np.column_stack([4 * np.sin(angle), 4 - 4 * np.cos(angle)])
    straight = turn[-1] + np.column_stack([np.zeros(334), 0.015 * np.arange(334)])
    path = np.concatenate([turn, np.repeat(turn[-1:], 600, axis=0), straight])
    positions = np.column_stack([path, np.zeros(len(path))])
    positions[:, :2] += np.random.default_rng(1).normal(scale=sigma, size=path.shape)
    assert path_length(positions) == pytest.approx(2 * np.pi + 5, rel=0.03)


def test_every_stream_has_its_role(log):
    (camera,) = log.cameras
    images = Images(np.array([1.0, 2.0]), (Path("a.png"), Path("b.jpg")))
    mount = Trajectory(np.array([1.0, 2.0]), np.tile(np.eye(4), (2, 1, 1)))
    full = replace(log, cameras=(replace(camera, rgb=images, depth=images, mount=mount),))
    streams = {stream.role: stream for stream in contents(full).streams}
    assert list(streams) == ["odometry", "localization", "detections", "image", "depth", "camera_poses", "truth"]
    assert streams["image"].detail == "jpg, png files"
    assert streams["camera_poses"].detail == "0.0 m"
    assert streams["detections"].timing.count == len(camera.detections.frame_stamps)
    assert streams["detections"].detail == f"{len(camera.detections)} boxes of 4 labels"
    assert contents(full).missing == ()


def test_two_cameras_are_told_apart(log):
    (camera,) = log.cameras
    other = replace(camera, camera=replace(camera.camera, name="rear"))
    roles = [stream.role for stream in contents(replace(log, cameras=(camera, other))).streams]
    assert roles == ["odometry", "localization", f"{camera.camera.name}.detections", "rear.detections", "truth"]


def test_what_is_missing(log):
    (camera,) = log.cameras
    blind = replace(camera, detections=None)
    images = replace(blind, rgb=Images(log.odometry.stamps[:2], (Path("a.png"), Path("b.png"))))
    name = camera.camera.name
    assert contents(replace(log, cameras=(blind,))).missing == (f"camera {name}: neither detections nor images",)
    (line,) = contents(replace(log, cameras=(images,))).missing
    assert line == f"camera {name}: no detections; run a detector on its images (--detector)"
    late = Trajectory(log.localization.stamps + 1e6, log.localization.poses)
    (line,) = contents(replace(log, localization=late)).missing
    assert "none of its frames" in line
    assert contents(replace(log, cameras=(), odometry=None, localization=None)).missing == (
        "there is neither odometry nor localisation",
        "there is no camera",
    )
