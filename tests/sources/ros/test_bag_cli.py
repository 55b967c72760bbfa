"""Bags on the command line: info, convert and run, and the options that choose."""

import json

import cv2
import numpy as np
import pytest
from bag_writer import write_bag
from drive_bag import nanoseconds, rows_of, simulated
from quick import QUICK

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.io.camera_yaml import write_camera
from objslam.io.results.read import load_map
from objslam.sources.log_folder import read_log_folder


@pytest.fixture(scope="module")
def log():
    return simulated()


@pytest.fixture(scope="module")
def rows(log, makers):
    """A drive with a second odometry, that stands still."""
    maker = makers["4"]
    still = [
        ("/wheels/far/odom", stamp, maker.odometry(stamp, np.eye(4), child="base_footprint"))
        for stamp in nanoseconds(log.odometry.stamps)
    ]
    return sorted(rows_of(log, maker) + still, key=lambda row: row[1])


@pytest.fixture
def bag(rows, makers, tmp_path):
    return write_bag(tmp_path / "drive", "mcap-zstd", makers["4"], rows)


def test_info_says_what_a_run_would_use(objslam, bag):
    code, out, err = objslam("info", bag)
    assert (code, err) == (0, "")
    words = {line.split()[0]: line.split() for line in out.splitlines()}
    assert words["/odom"][1:3] == ["odometry", "nav_msgs/Odometry"]
    assert words["/amcl_pose"][1] == "localization"
    assert words["/wheels/far/odom"][1] == "nav_msgs/Odometry"  # no role
    assert "base_footprint -> base_link -> front_link -> front_optical_frame" in out
    assert "several fit odometry: /odom is taken, not /wheels/far/odom (--topic odometry=... chooses)" in out
    assert "nothing is missing for a run" in out


def test_info_describes_the_part_that_is_asked_for(objslam, bag, log):
    begin, end = np.quantile(log.odometry.stamps, [0.25, 0.75])
    frames = log.cameras[0].detections.frame_stamps
    code, out, err = objslam("info", bag, "--begin", begin, "--end", end)
    assert (code, err) == (0, "")
    assert f"This is a part of the recording: from stamp {begin:.3f} to {end:.3f} s." in out
    assert f" in {((frames >= begin) & (frames < end)).sum()} frames." in out
    part = json.loads(objslam("info", bag, "--begin", begin, "--json")[1])["part"]
    assert part["part"] == [begin, None]


def test_stamps_of_a_simulation_in_a_recording_by_the_wall_clock(objslam, rows, makers, tmp_path):
    """Gazebo's clock starts at zero. Without --use-sim-time, `ros2 bag record` writes the times of the wall clock."""
    late = 1_700_000_000 * 10**9
    bag = write_bag(tmp_path / "sim", "mcap-none", makers["4"], [(topic, t + late, message) for topic, t, message in rows])
    code, out, err = objslam("info", bag)
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if "on another clock" in line]
    assert "/odom" in line
    assert "/tf_static" not in line
    (odometry,) = [line.split() for line in out.splitlines() if line.startswith("/odom ")]
    assert float(odometry[6]) == 0.0
    assert 0 < float(odometry[7]) < 1000


def test_info_takes_the_same_choices_as_a_run(objslam, bag):
    _, out, _ = objslam("info", bag, "--topic", "odometry=/wheels/far/odom", "--topic", "detections=none")
    words = {line.split()[0]: line.split() for line in out.splitlines()}
    assert words["/wheels/far/odom"][1] == "odometry"
    assert "missing for a run:" in out
    _, out, _ = objslam("info", bag, "--base-frame", "front_link")
    assert "base frame front_link" in out


def test_a_chosen_topic_is_what_is_read(objslam, bag, log, tmp_path):
    for name, topics in (("moving", ()), ("still", ("--topic", "odometry=/wheels/far/odom"))):
        assert objslam("convert", bag, tmp_path / name, *topics)[0] == 0
    moving, still = (read_log_folder(tmp_path / name, Ledger()).odometry for name in ("moving", "still"))
    np.testing.assert_allclose(moving.poses, log.odometry.poses, atol=1e-9)
    assert np.array_equal(still.poses, np.tile(np.eye(4), (len(still), 1, 1)))


def test_a_calibration_file_and_a_base_frame_are_used(objslam, rows, makers, log, tmp_path):
    from dataclasses import replace

    bare = [row for row in rows if not row[0].endswith("camera_info") and row[0] != "/wheels/far/odom"]
    bag = write_bag(tmp_path / "bare", "sqlite3", makers["4"], bare)
    assert objslam("run", bag, "-o", tmp_path / "none")[0] == 1
    camera = log.cameras[0].camera
    write_camera(
        replace(camera, base_T_camera=lift_se2(np.array([0.0, 0.0, 0.1])) @ camera.base_T_camera), tmp_path / "c.yaml"
    )
    code, _, err = objslam("convert", bag, tmp_path / "log", "--camera-info", tmp_path / "c.yaml")
    assert code == 0, err
    (found,) = read_log_folder(tmp_path / "log", Ledger()).cameras
    expected = lift_se2(np.array([0.0, 0.0, 0.1])) @ camera.base_T_camera
    np.testing.assert_allclose(found.camera.base_T_camera, expected, atol=1e-9)


def test_a_bag_runs_as_its_folder_does(objslam, bag, tmp_path):
    assert objslam("convert", bag, tmp_path / "log")[0] == 0
    for source, out in ((bag, "from_bag"), (tmp_path / "log", "from_folder")):
        code, _, err = objslam("run", source, "-o", tmp_path / out, *QUICK)
        assert code == 0, err
    one, other = (load_map(tmp_path / out).objects for out in ("from_bag", "from_folder"))
    assert len(one) == len(other) >= 3
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1e-6)


def test_convert_brings_images_and_depth(objslam, rows, makers, log, tmp_path):
    maker, rng = makers["4"], np.random.default_rng(0)
    camera = log.cameras[0].camera
    size = camera.height, camera.width
    stamps = nanoseconds(log.cameras[0].detections.frame_stamps[:3])
    colour = [rng.integers(0, 256, (*size, 3)).astype(np.uint8) for _ in stamps]
    depth = [rng.uniform(0.5, 9, size).astype(np.float32) for _ in stamps]
    optical = "front_optical_frame"
    more = [("/front/image_raw", t, maker.image(t, c, "bgr8", optical)) for t, c in zip(stamps, colour, strict=True)]
    more += [("/front/depth/image", t, maker.image(t, d, "32FC1", optical)) for t, d in zip(stamps, depth, strict=True)]
    bag = write_bag(tmp_path / "in" / "drive", "sqlite3", maker, sorted(rows + more, key=lambda row: row[1]))
    code, _, err = objslam("convert", bag, tmp_path / "out" / "log", "--topic", "odometry=/odom")
    assert code == 0, err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["log"]  # nothing is left beside it
    (camera_log,) = read_log_folder(tmp_path / "out" / "log", Ledger()).cameras
    np.testing.assert_allclose(camera_log.rgb.stamps, np.array(stamps) / 1e9, atol=1e-9)
    for paths, kind in ((camera_log.rgb.paths, "rgb"), (camera_log.depth.paths, "depth")):
        assert all(path.parent == tmp_path / "out" / "log" / kind for path in paths)
    for path, expected in zip(camera_log.rgb.paths, colour, strict=True):
        assert np.array_equal(cv2.imread(str(path)), expected)
    for path, expected in zip(camera_log.depth.paths, depth, strict=True):
        metres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / camera_log.camera.depth_scale
        np.testing.assert_allclose(metres, expected, atol=0.0005001)
    assert np.isfinite(camera_log.detections.depths).any()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--topic", "odometry=/odm"), 2, ("/odm is not in the bag", "/odom")),
        (("--topic", "odometry"), 2, ("is not role=/name",)),
        (("--topic", "odometry=/front/detections"), 2, ("has the type vision_msgs",)),
        (("--camera-info", "nowhere.yaml"), 1, ("nowhere.yaml",)),
        (("--base-frame", "moon"), 1, ("moon",)),
    ],
)
@pytest.mark.parametrize("command", ["run", "convert", "info"])
def test_wrong_choices(objslam, bag, tmp_path, command, arguments, code, words):
    out = {"run": ("-o", tmp_path / "a" / "b"), "convert": (tmp_path / "a" / "b",), "info": ()}[command]
    found, _, err = objslam(command, bag, *out, *arguments)
    if command == "info" and arguments[0] == "--base-frame":  # told, not refused
        assert found == 0
        return
    assert found == code
    assert len(err.strip().splitlines()) == 1
    assert all(word in err for word in words), err
    assert not (tmp_path / "a").exists()
