"""What the importers make of real recordings, held against facts counted from the files themselves."""

import gzip
import tarfile
from collections import Counter

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.sources import SourceOptions, read
from objslam.sources.log_folder import read_log_folder, write_log_folder

_MRCLAM_BOXES = {1: (1234, 1534, 407, 1), 3: (2745, 4348, 1277, 2), 5: (2791, 4239, 1139, 0)}
_OFFICE_BOXES = {"bottle": 5372, "chair": 2429, "book": 2206, "tv": 1439, "cup": 1392, "keyboard": 1128, "mouse": 995}


@pytest.fixture(scope="module", params=sorted(_MRCLAM_BOXES))
def mrclam(request, data_dir):
    ledger = Ledger()
    robot = request.param
    return robot, read(data_dir / "mrclam_ds6", ledger, SourceOptions(robot=robot)), ledger


def _bearings(camera, boxes):
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    rays = np.linalg.solve(camera.matrix, np.column_stack([centre, np.ones(len(centre))]).T).T
    rays = rays @ camera.base_T_camera[:3, :3].T
    return np.arctan2(rays[:, 1], rays[:, 0])


def test_mrclam_counts(mrclam):
    robot, log, ledger = mrclam
    frames, boxes, robots, unknown = _MRCLAM_BOXES[robot]
    detections = log.cameras[0].detections
    assert (len(detections.frame_stamps), len(detections)) == (frames, boxes)
    assert set(detections.label_names) == {f"landmark_{subject}" for subject in range(6, 21)}
    assert len(log.truth.objects) == 15
    expected = {"measurement of another robot": robots, "measurement of an unknown barcode": unknown}
    assert ledger.dropped == {reason: count for reason, count in expected.items() if count}
    camera = log.cameras[0].camera
    assert (detections.boxes > 2).all()
    assert (detections.boxes < [camera.width - 2, camera.height - 2] * 2).all()


def test_mrclam_bearings_and_ranges_survive_the_camera(mrclam, data_dir):
    robot, log, _ = mrclam
    folder = data_dir / "mrclam_ds6"
    rows = np.loadtxt(folder / f"Robot{robot}_Measurement.dat.gz")
    subject = {int(b): int(s) for s, b in np.loadtxt(folder / "Barcodes.dat")}
    rows = rows[[subject.get(int(code), 0) > 5 for code in rows[:, 1]]]
    detections, camera = log.cameras[0].detections, log.cameras[0].camera
    assert np.array_equal(detections.stamps, rows[:, 0])
    bearing = _bearings(camera, detections.boxes)
    np.testing.assert_allclose(bearing, rows[:, 3], atol=1e-12)
    np.testing.assert_allclose(detections.depths, rows[:, 2], rtol=1e-12)
    labels = [f"landmark_{subject[int(code)]}" for code in rows[:, 1]]
    assert [detections.label_names[i] for i in detections.label] == labels


def test_mrclam_measurements_agree_with_the_truth(mrclam):
    _, log, _ = mrclam
    detections, path = log.cameras[0].detections, log.truth.trajectory
    poses, valid = interpolate(path.stamps, path.poses, detections.stamps, 0.5)
    place = {o.label: o.position for o in log.truth.objects}
    landmark = np.array([place[detections.label_names[i]] for i in detections.label])
    seen = np.einsum("nji,nj->ni", poses[:, :3, :3], landmark - poses[:, :3, 3])[valid]
    off = np.degrees(np.arctan2(seen[:, 1], seen[:, 0]) - _bearings(log.cameras[0].camera, detections.boxes)[valid])
    assert 0.2 < np.median(np.abs(off)) < 1.0
    assert np.median(np.abs(seen[:, 0] - detections.depths[valid])) < 0.15


def test_mrclam_odometry_follows_the_truth_for_a_while(mrclam):
    _, log, _ = mrclam
    stamps = log.odometry.stamps[0] + np.array([0.0, 20.0])
    odometry, _ = interpolate(log.odometry.stamps, log.odometry.poses, stamps, 2.0)
    truth, valid = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, stamps, 2.0)
    assert valid.all()
    moved, expected = (np.linalg.inv(poses[0]) @ poses[1] for poses in (odometry, truth))
    driven = np.linalg.norm(expected[:2, 3])
    assert driven > 0.5
    assert np.linalg.norm((moved - expected)[:2, 3]) < 0.25 * driven
    assert len(log.odometry) > 60_000
    assert 885 < log.odometry.stamps[-1] - log.odometry.stamps[0] < 890


def test_mrclam_as_a_log_folder(mrclam, tmp_path):
    _, log, _ = mrclam
    write_log_folder(log, tmp_path / "log")
    ledger = Ledger()
    again = read_log_folder(tmp_path / "log", ledger)
    assert not ledger.lines()
    assert np.array_equal(again.odometry.stamps, log.odometry.stamps)
    np.testing.assert_allclose(again.odometry.poses, log.odometry.poses, atol=1e-14)
    for name, value in vars(log.cameras[0].detections).items():
        np.testing.assert_array_equal(getattr(again.cameras[0].detections, name), value)


def test_cube_slam(data_dir):
    ledger = Ledger()
    log = read(data_dir / "cube_slam", ledger, SourceOptions(label="cabinet"))
    (camera_log,) = log.cameras
    detections = camera_log.detections
    assert (len(detections.frame_stamps), len(detections)) == (58, 51)
    assert detections.label_names == ("cabinet",)
    assert np.array_equal(detections.frame_stamps, log.localization.stamps)
    assert len(camera_log.rgb.paths) == len(camera_log.depth.paths) == 58
    assert not ledger.dropped
    assert np.isfinite(detections.depths).all()
    assert (0.5 < detections.depths).all()
    assert (detections.depths < 5).all()


def test_cube_slam_rows_are_the_images_numbers(data_dir):
    log = read(data_dir / "cube_slam", Ledger())
    camera, depth = log.cameras[0].camera, log.cameras[0].depth
    columns, rows = np.meshgrid(np.arange(0, 640, 8), np.arange(0, 480, 8))
    rays = np.linalg.solve(camera.matrix, np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)]))
    images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::8, ::8].ravel() / camera.depth_scale for path in depth.paths]

    def on_floor(shift):
        share = []
        for pose, image in zip(log.localization.poses[max(shift, 0) :], images[max(-shift, 0) :], strict=False):
            points = pose[:3, :3] @ (rays * image)[:, image > 0] + pose[:3, 3:]
            share.append((np.abs(points[2]) < 0.02).mean())
        return np.mean(share)

    assert on_floor(0) > 0.5
    assert max(on_floor(shift) for shift in (-2, -1, 1, 2)) < 0.3


def test_tum_office(data_dir):
    ledger = Ledger()
    folder = data_dir / "tum_fr3_office"
    log = read(folder, ledger)
    detections = log.cameras[0].detections
    assert len(detections.frame_stamps) == 2585
    counts = Counter(detections.label_names[i] for i in detections.label)
    assert {name: counts[name] for name in _OFFICE_BOXES} == _OFFICE_BOXES
    with tarfile.open(folder / "yolov3_boxes.tar.gz") as archive:
        rows = sum(len(archive.extractfile(m).read().split()) for m in archive if m.isfile())
    assert len(detections) == rows / 6
    assert not ledger.dropped
    with gzip.open(folder / "groundtruth.txt.gz", "rt") as file:
        truth = np.loadtxt(file)
    assert np.array_equal(log.localization.stamps, truth[:, 0])
    np.testing.assert_allclose(log.localization.poses[:, :3, :3], Rotation.from_quat(truth[:, 4:]).as_matrix(), atol=1e-12)
