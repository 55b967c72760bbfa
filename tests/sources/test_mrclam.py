import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.sources.mrclam import MrclamOptions
from objslam.sources.mrclam.reader import bearing_to_pixel, integrate, is_mrclam, read_mrclam, robots

_BARCODES = "# Subject Barcode\n 1 \t 5\n 3 41\n 6 63\n 7 81\n 20 25\n"
_ODOMETRY = "# t v w\n100.0 1.0 0.5\n100.5 1.0 0.5\n101.0 0.0 0.5\n101.0 2.0 0.0\n102.0 0.0 0.0\n"
_MEASUREMENT = "\n".join(
    [
        "# t barcode range bearing",
        "100.1 63 2.0 0.3",
        "100.1 81 4.0 -0.4",
        "100.1 41 1.0 0.0",  # another robot
        "100.6 5 3.0 0.1",  # only another robot: a frame without a box
        "101.0 99 3.0 0.1",  # unknown
        "101.0 25 3.0 0.0",
        "101.5 25 3.0 1.2",  # no such bearing can be seen
        "101.6 25 -3.0 0.1",  # no range
        "101.6 25 1.0",
        "101.2 25 3.0 0.0",  # back
    ]
)
_LANDMARKS = "6 1.5 -2.5 0.1 0.1\n20 0.25 3.0 0.1 0.1\n21 0 0 0 0\n"
_TRUTH = "100.0 1.0 2.0 0.5\n100.0 1.0 2.0 0.5\n101.0 1.5 2.0 0.75\n"


@pytest.fixture
def dataset(tmp_path):
    folder = tmp_path / "mrclam"
    folder.mkdir()
    (folder / "Barcodes.dat").write_text(_BARCODES)
    (folder / "Robot2_Odometry.dat").write_text(_ODOMETRY)
    (folder / "Robot2_Measurement.dat.gz").write_bytes(gzip.compress(_MEASUREMENT.encode()))
    (folder / "Landmark_Groundtruth.dat").write_text(_LANDMARKS)
    (folder / "Robot2_Groundtruth.dat").write_text(_TRUTH)
    (folder / "Robot4_Odometry.dat.gz").write_bytes(b"")
    return folder


def test_a_circle_is_driven_exactly():
    stamps = np.array([0.0, 0.1, 1.0, 4.0, 9.0])
    speed, rate = 0.7, -0.9
    x_y_yaw = integrate(stamps, np.tile([speed, rate], (5, 1)))
    radius, angle = speed / rate, rate * stamps
    expected = np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle])
    np.testing.assert_allclose(x_y_yaw, expected, atol=1e-13)


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(-2, 2), st.floats(-4, 4)), min_size=1, max_size=12))
def test_integration_is_the_product_of_exponentials(rows):
    steps, velocities = np.array([row[0] for row in rows]), np.array([row[1:] for row in rows])
    stamps = np.concatenate([[0.0], np.cumsum(steps)])[:-1]
    pose = np.eye(3)
    expected = [pose]
    for dt, (speed, rate) in zip(np.diff(stamps), velocities, strict=False):
        pose = pose @ expm(dt * np.array([[0, -rate, speed], [rate, 0, 0], [0, 0, 0]]))
        expected.append(pose)
    result = integrate(stamps, velocities)
    np.testing.assert_allclose(result[:, :2], np.array(expected)[:, :2, 2], atol=1e-9)
    np.testing.assert_allclose(np.cos(result[:, 2]), np.array(expected)[:, 0, 0], atol=1e-9)


def test_a_robot_is_read(dataset):
    ledger = Ledger()
    log = read_mrclam(dataset, ledger, MrclamOptions(2))
    assert log.name == "mrclam_robot2"
    assert log.localization is None
    assert log.odometry.stamps.tolist() == [100.0, 100.5, 101.0, 102.0]
    # an arc of radius 2 for 1 s, then 2 m straight on, with the velocity of the second row stamped 101
    end = np.array([2 * np.sin(0.5) + 2 * np.cos(0.5), 2 * (1 - np.cos(0.5)) + 2 * np.sin(0.5), 0])
    np.testing.assert_allclose(log.odometry.poses[-1, :3, 3], end, atol=1e-14)
    np.testing.assert_allclose(log.odometry.poses[0], np.eye(4))

    (camera_log,) = log.cameras
    assert not camera_log.camera.sees_size  # bearings: the boxes are made up
    detections, camera = camera_log.detections, camera_log.camera
    assert detections.frame_stamps.tolist() == [100.1, 100.6, 101.0, 101.5, 101.6]
    assert [detections.label_names[i] for i in detections.label] == [
        "landmark_6",
        "landmark_7",
        "landmark_20",
        "landmark_20",
    ]
    assert detections.frame.tolist() == [0, 0, 2, 4]
    assert detections.scores.tolist() == [1.0] * 4
    centre = (detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2
    rays = np.linalg.solve(camera.matrix, np.column_stack([centre, np.ones(4)]).T).T @ camera.base_T_camera[:3, :3].T
    np.testing.assert_allclose(np.arctan2(rays[:, 1], rays[:, 0]), [0.3, -0.4, 0.0, 0.1], atol=1e-13)
    np.testing.assert_allclose(rays[:, 2], 0, atol=1e-13)
    np.testing.assert_allclose(detections.depths, [2.0, 4.0, 3.0, np.nan])  # What the dataset calls ranges.

    measurement = dataset / "Robot2_Measurement.dat.gz"
    assert ledger.dropped == {
        "measurement line that is not 4 numbers": 1,
        "measurement line with a stamp that goes back": 1,
        "measurement of an unknown barcode": 1,
        "measurement of another robot": 2,
        "measurement with a bearing outside the virtual camera's view": 1,
        "range that is not above zero or too large (taken as unknown)": 1,
        "landmark line with a subject that is no landmark": 1,
    }
    assert ledger.examples["measurement of another robot"] == [f"{measurement}:4", f"{measurement}:5"]
    assert ledger.examples["measurement line that is not 4 numbers"] == [f"{measurement}:10"]


def test_the_truth_is_read(dataset):
    truth = read_mrclam(dataset, Ledger(), MrclamOptions(2)).truth
    assert [(o.id, o.label, o.position.tolist()) for o in truth.objects] == [
        (6, "landmark_6", [1.5, -2.5, 0.0]),
        (20, "landmark_20", [0.25, 3.0, 0.0]),
    ]
    assert truth.trajectory.stamps.tolist() == [100.0, 101.0]
    assert truth.trajectory.poses[0, :2, 3].tolist() == [1.0, 2.0]
    assert np.arctan2(truth.trajectory.poses[1, 1, 0], truth.trajectory.poses[1, 0, 0]) == pytest.approx(0.75)


def test_options(dataset):
    log = read_mrclam(dataset, Ledger(), MrclamOptions(2, with_range=False, anonymous=True))
    assert np.isnan(log.cameras[0].detections.depths).all()
    assert log.cameras[0].detections.label_names == ("landmark",)
    assert {o.label for o in log.truth.objects} == {"landmark"}
    assert (log.cameras[0].detections.track_ids == -1).all()  # nothing else tells them apart


def test_every_bearing_of_a_60_degree_camera_fits_into_the_image():
    assert bearing_to_pixel(np.array([0.0])) == 320
    edges = bearing_to_pixel(np.radians([39.0, -39.0]))
    assert 0 < edges[0] < edges[1] < 640
    assert bearing_to_pixel(np.radians([-0.45]))[0] - 320 == pytest.approx(3.0, abs=0.1)  # the default noise of a box


def test_without_truth(dataset):
    (dataset / "Landmark_Groundtruth.dat").unlink()
    (dataset / "Robot2_Groundtruth.dat").unlink()
    assert read_mrclam(dataset, Ledger(), MrclamOptions(2)).truth is None


@pytest.mark.parametrize(("robot", "message"), [(None, "no robot is chosen"), (5, "there is no robot 5")])
def test_the_robots_are_listed(dataset, robot, message):
    assert is_mrclam(dataset)
    assert robots(dataset) == (2, 4)
    with pytest.raises(LogError, match=message + ", the folder has: 2, 4"):
        read_mrclam(dataset, Ledger(), MrclamOptions(robot))


def test_what_is_missing_or_damaged_is_named(dataset):
    with pytest.raises(LogError, match=r"neither Robot4_Measurement\.dat nor") as caught:
        read_mrclam(dataset, Ledger(), MrclamOptions(4))
    assert caught.value.where == str(dataset)
    (dataset / "Robot4_Measurement.dat").write_text(_MEASUREMENT)
    with pytest.raises(LogError, match="nothing in it") as caught:
        read_mrclam(dataset, Ledger(), MrclamOptions(4))
    assert caught.value.where == str(dataset / "Robot4_Odometry.dat.gz")
    (dataset / "Barcodes.dat").write_text("a b\n")
    with pytest.raises(LogError) as caught:
        read_mrclam(dataset, Ledger(), MrclamOptions(2))
    assert caught.value.where == str(dataset / "Barcodes.dat")


def test_absurd_numbers_are_survived(dataset):
    (dataset / "Barcodes.dat").write_text(_BARCODES + "1e300 7\n6.5 8\n-3 9\n")
    (dataset / "Robot2_Measurement.dat.gz").unlink()
    (dataset / "Robot2_Measurement.dat").write_text("1 7 1 0\n1 8 1 0\n1 1e300 1 0\n1 63 1e300 0\n1 63 1 1e300\n")
    ledger = Ledger()
    log = read_mrclam(dataset, ledger, MrclamOptions(2))
    assert len(log.cameras[0].detections) == 1
    assert ledger.dropped["measurement of an unknown barcode"] == 3
