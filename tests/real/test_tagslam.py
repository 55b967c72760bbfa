"""A real ROS 1 recording of AprilTags in a building, with two fisheye cameras and visual odometry, and surveyed tags."""

import bz2
import functools
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from objslam.config import load_settings
from objslam.core.camera import undistort
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, interpolate, inverse, make_pose
from objslam.io.camera_yaml import read_calibrations
from objslam.mapping import pipeline
from objslam.ros.bag.recording import find_recording, read_messages
from objslam.ros.messages.decode import make_decoder, read_head
from objslam.ros.messages.poses import PoseRows
from objslam.sources import SourceOptions, read
from objslam.sources.ros_bag.info import describe

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CALIBRATION, SETTINGS = CONFIGS / "cameras" / "tagslam.yaml", CONFIGS / "tags.yaml"
_MISSURVEYED = "tag_79"
_decoder = functools.cache(make_decoder)


def _vector(mapping):
    return np.array([mapping["x"], mapping["y"], mapping["z"]])


def _pose(mapping):
    return make_pose(Rotation.from_rotvec(_vector(mapping["rotation"])).as_matrix(), _vector(mapping["position"]))


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "tagslam_building"


@pytest.fixture(scope="module")
def survey(folder):
    """Surveyed positions of tags by label, and the pose of the odometry's frame on the rig."""
    bodies = yaml.safe_load((folder / "tagslam.yaml").read_text())["bodies"]
    tags = {f"tag_{tag['id']}": _vector(tag["pose"]["position"]) for tag in bodies[0]["top_floor"]["tags"]}
    return tags, _pose(bodies[1]["rig"]["T_body_odom"])


@pytest.fixture(scope="module")
def log(folder):
    ledger = Ledger()
    found = read(folder, ledger, SourceOptions(camera_info=CALIBRATION))
    assert not ledger.lines()
    return found


def test_the_calibration_is_that_of_the_data(folder, survey):
    """configs/cameras/tagslam.yaml against the recording's own files."""
    cameras = yaml.safe_load((folder / "cameras.yaml").read_text())
    poses = yaml.safe_load((folder / "camera_poses.yaml").read_text())
    for calibration, name in zip(read_calibrations(CALIBRATION, Ledger()), ("cam0", "cam1"), strict=True):
        camera, given = calibration.camera, cameras[name]
        assert [camera.width, camera.height] == given["resolution"]
        assert camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == given["intrinsics"]
        assert camera.distortion.tolist() == given["distortion_coeffs"]
        expected = inverse(survey[1]) @ _pose(poses[name]["pose"])
        np.testing.assert_allclose(camera.base_T_camera, expected, atol=1e-8)


def test_what_is_inside(folder, log):
    info = describe(folder)
    assert info.format == "ROS 1 bag"
    assert info.messages == 13_500
    assert {topic.name: topic.role for topic in info.topics} == {
        "/fla/ovc_node/left/tags": "fla_left_cam.detections",
        "/fla/ovc_node/right/tags": "fla_right_cam.detections",
        "/fla/vio/odom": "odometry",
    }
    assert all("no CameraInfo belongs to this camera" in line for line in info.missing)
    assert [c.camera.name for c in log.cameras] == ["left", "right"]
    assert [len(c.detections) for c in log.cameras] == [1876, 1759]
    assert len(log.odometry) == 4500
    assert all(c.detections.whole for c in log.cameras)
    assert log.localization is None


def test_the_rays_point_at_the_surveyed_tags(folder, log, survey, tmp_path):
    """With the poses of TagSLAM's own optimum: clock, frames, fisheye and the place of the cameras are all right."""
    reference = tmp_path / "reference.bag"
    reference.write_bytes(bz2.decompress((folder / "reference.bag.bz2").read_bytes()))
    rows = PoseRows()
    wanted = read_messages(find_recording(reference, Ledger()), lambda c: c.topic == "/tagslam/odom/body_rig", [])
    for connection, logged, data in wanted:
        message = _decoder(connection)(data)
        pose = message.pose.pose
        rows.add(read_head(data, "ros1")[0], logged, pose.position, pose.orientation)
    stamps, map_T_rig = rows.checked("pose", Ledger())
    tags, rig_T_odom = survey
    off: dict[str, list[float]] = {}
    for camera_log in log.cameras:
        camera, detections = camera_log.camera, camera_log.detections
        poses, known = interpolate(stamps, map_T_rig @ rig_T_odom, detections.stamps, 0.2)
        map_T_camera = poses @ camera.base_T_camera
        directions, valid = undistort(camera, (detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2)
        assert valid.all()
        labels = [detections.label_names[i] for i in detections.label]
        for i in np.flatnonzero(known):
            if labels[i] in tags:
                there = map_T_camera[i, :3, :3].T @ (tags[labels[i]] - map_T_camera[i, :3, 3])
                cos = directions[i] @ there / np.linalg.norm(there)
                off.setdefault(labels[i], []).append(float(np.degrees(np.arccos(np.clip(cos, -1, 1)))))
    medians = {label: float(np.median(values)) for label, values in off.items()}
    assert len(medians) == 20
    assert medians.pop(_MISSURVEYED) > 3
    assert np.median(list(medians.values())) < 0.6  # deg
    assert max(medians.values()) < 2.5


def _errors(log, tags, mode):
    """Errors (m) of the tags that are mapped, after alignment with the surveyed ones."""
    ledger = Ledger()
    result = pipeline.run(log, load_settings(SETTINGS, (f"mode={mode}",)), ledger)
    assert not ledger.dropped
    best = {o.label: o for o in sorted(result.map.resolved(), key=lambda o: o.rays) if o.label in tags}
    mapped = list(best.values())
    found, true = np.array([o.position for o in mapped]), np.array([tags[o.label] for o in mapped])
    pose, _ = align(found, true, "se3")
    return np.linalg.norm(found @ pose[:3, :3].T + pose[:3, 3] - true, axis=1)


def test_the_map_of_the_building(log, survey):
    fixed, joint = (_errors(log, survey[0], mode) for mode in ("fixed", "joint"))
    assert len(joint) == 20  # every surveyed tag that the recording holds
    assert np.median(joint) < 0.15  # m, over a walk of 140 m
    assert np.median(joint) < 0.5 * np.median(fixed)
    assert joint.max() < 0.6 < fixed.max()
