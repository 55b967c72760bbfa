"""A replayed recording whose boxes a detector finds: `objslam live RECORDING --detector MODEL`."""

import cv2
import numpy as np
import pytest
from quick import QUICK
from tiny_models import COLOURS, scene, tiny_model

from objslam.core.camera import Camera
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.io.results.read import load_map
from objslam.sources.log_folder import write_log_folder

WIDTH, HEIGHT, FOCAL, FRAMES = 320, 240, 200.0, 25
THINGS = {"red": (0.8, 3.0, 0.5), "green": (1.4, 2.5, 0.7)}  # m in map
HALF = 0.15  # m, half the side of a thing
LEFT = make_pose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.0, 0.0, 0.5]))  # the camera looks to the left


def box(x, place):
    """The pixels of a thing, seen from x on the robot's straight way."""
    depth = place[1]
    u, v = WIDTH / 2 + FOCAL * (place[0] - x) / depth, HEIGHT / 2 + FOCAL * (0.5 - place[2]) / depth
    half = FOCAL * HALF / depth
    return [round(value) for value in (u - half, v - half, u + half, v + half)]


@pytest.fixture
def recording(tmp_path):
    """A log folder of a robot that drives 2 m along x past the things, with images and without boxes."""
    (tmp_path / "seen").mkdir()
    ways = np.linspace(0.0, 2.0, FRAMES)
    files = tuple(tmp_path / "seen" / f"{i:03d}.png" for i in range(FRAMES))
    for file, x in zip(files, ways, strict=True):
        cv2.imwrite(str(file), scene([box(x, place) for place in THINGS.values()], WIDTH, HEIGHT))
    stamps = 10 + 0.2 * np.arange(FRAMES)
    matrix = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    camera = CameraLog(Camera("front", WIDTH, HEIGHT, matrix, base_T_camera=LEFT), rgb=Images(stamps, files))
    poses = lift_se2(np.stack([ways, 0 * ways, 0 * ways], axis=1))
    write_log_folder(Log("log", (camera,), None, Trajectory(stamps, poses)), tmp_path / "log")
    return tmp_path / "log"


@pytest.fixture
def live(recording, tmp_path, objslam, monkeypatch):
    """The command on the recording, without boxes of another run in the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return lambda *more: objslam("live", recording, "-o", tmp_path / "out", "--speed", "0", *QUICK, *more)


def test_a_detector_finds_the_boxes_of_a_replay(live, tmp_path):
    model = tiny_model(tmp_path / "m.onnx", "yolov8", size=(320, 320), metadata={"names": list(COLOURS)})
    done = live("--detector", model)
    assert done.code == 0, done.err
    assert "has no meaning" not in done.err
    found = {o.label: o.position for o in load_map(tmp_path / "out").resolved()}
    assert set(found) == set(THINGS)
    for name, place in THINGS.items():
        np.testing.assert_allclose(found[name], place, atol=0.05)


def test_a_replay_without_boxes_is_refused_at_once(live, tmp_path):
    done = live()
    assert done.code == 1
    assert len(done.err.splitlines()) == 1
    assert "no boxes to replay" in done.err
    assert "--detector" in done.err
    assert not (tmp_path / "out").exists()
