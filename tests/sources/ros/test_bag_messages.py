"""What is made of single messages: boxes of detectors, tags, calibrations."""

import cv2
import numpy as np
import pytest
from bag_writer import Maker, serialize
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from objslam.core.camera import Camera
from objslam.core.geometry import make_pose
from objslam.errors import LogError
from objslam.ros.bag.records import Connection, type_name
from objslam.ros.messages.camera_info import camera_of
from objslam.ros.messages.decode import DecodeError, make_decoder, read_head, read_length
from objslam.ros.messages.detections import boxes_of_points, tag_boxes, vision_boxes

_K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
_FISHEYE = Camera("c", 640, 480, _K, "equidistant", np.array([0.01, -0.02, 0.003, -0.001]))
_PLUMB = Camera("c", 640, 480, _K, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))


@pytest.mark.parametrize("vision", "1234")
def test_boxes_of_every_layout(makers, vision):
    message = makers[vision].detections(0, [(10, 20, 110, 60, 7, 0.5), (0, 0, 4, 4, 3, 0.25)])
    found = list(vision_boxes(message))
    assert [f.box for f in found] == [[10, 20, 110, 60], [0, 0, 4, 4]]
    assert [f.label for f in found] == ["7", "3"]
    assert [f.score for f in found] == [0.5, 0.25]
    assert [f.track for f in found] == ["", ""]


@pytest.mark.parametrize("vision", "234")
def test_the_trackers_name(makers, vision):
    message = makers[vision].detections(0, [(0, 0, 4, 4, "cup", 0.5, "t7")])
    assert next(vision_boxes(message)).track == "t7"


def test_the_best_hypothesis_and_a_turned_box(makers):
    maker = makers["4"]
    message = maker.detections(0, [(0, 0, 4, 4, "cup", 0.3), (100, 100, 140, 120, "a", 0.5)])
    cup, turned = message.detections
    cup.results.append(maker.detections(0, [(0, 0, 1, 1, "bowl", 0.6)]).detections[0].results[0])
    cup.results.append(maker.detections(0, [(0, 0, 1, 1, "plate", 0.1)]).detections[0].results[0])
    turned.bbox.center.theta = np.pi / 2
    found = list(vision_boxes(message))
    assert (found[0].label, found[0].score) == ("bowl", 0.6)
    np.testing.assert_allclose(found[1].box, [110, 90, 130, 130])
    cup.results.clear()
    assert next(vision_boxes(message)).label == ""


def _square(pose, size=0.2):
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size / 2
    return corners @ pose[:3, :3].T + pose[:3, 3]


@given(st.integers(0, 10**6))
def test_the_centre_of_a_tag_is_the_image_of_its_centre(seed):
    """In a pinhole picture, lines stay lines: the diagonals meet where the middle of the square is seen."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.uniform(-0.9, 0.9, 3)).as_matrix()
    pose = make_pose(turn, np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(1, 3)]))
    pixels = (_K @ _square(pose).T).T
    corners = pixels[:, :2] / pixels[:, 2:]
    (found,) = tag_boxes(_MAKER.tags(0, [(12, corners)]))
    middle = _K @ pose[:3, 3]
    x1, y1, x2, y2 = found.box
    np.testing.assert_allclose([(x1 + x2) / 2, (y1 + y2) / 2], middle[:2] / middle[2], atol=1e-8)
    assert (corners >= [x1 - 1e-9, y1 - 1e-9]).all()
    assert (corners <= [x2 + 1e-9, y2 + 1e-9]).all()
    assert np.isclose(corners.max(axis=0), [x2, y2]).any() or np.isclose(corners.min(axis=0), [x1, y1]).any()
    assert (found.label, found.score) == ("tag_12", 1.0)
    np.testing.assert_array_equal(found.corners, corners)


_MAKER = Maker("4")


def test_a_tag_that_is_no_square_has_no_box():
    flat = np.zeros((4, 2))
    assert np.isnan(next(tag_boxes(_MAKER.tags(0, [(1, flat)]))).box).all()


@pytest.mark.parametrize("camera", [_FISHEYE, _PLUMB], ids=["fisheye", "plumb_bob"])
def test_a_tag_of_which_only_the_pose_is_told(camera):
    pose = make_pose(Rotation.from_euler("xyz", [0.3, -0.4, 0.2]).as_matrix(), np.array([0.3, -0.2, 2.0]))
    behind = make_pose(np.eye(3), np.array([0.0, 0.0, -2.0]))
    message = _MAKER.tag_poses(0, [([5], 0.2, pose), ([6, 7], 0.2, pose), ([8], 0.2, behind)])
    found = list(tag_boxes(message))
    assert [f.label for f in found] == ["tag_5", "tag_8"]  # a bundle of tags is no single thing
    np.testing.assert_allclose(found[0].points[0], pose[:3, 3])
    np.testing.assert_allclose(found[0].points[1:], _square(pose), atol=1e-12)
    boxes = boxes_of_points(camera, np.array([f.points for f in found]))
    assert np.isnan(boxes[1]).all()
    points = np.vstack([pose[:3, 3], _square(pose)])[:, None]
    project = cv2.fisheye.projectPoints if camera.distortion_model == "equidistant" else cv2.projectPoints
    pixels = project(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
    np.testing.assert_allclose((boxes[0, :2] + boxes[0, 2:]) / 2, pixels[0])
    assert (pixels[1:] >= boxes[0, :2] - 1e-9).all()
    assert (pixels[1:] <= boxes[0, 2:] + 1e-9).all()


def test_a_tag_that_the_lens_cannot_see_has_no_box():
    lens = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])  # folds back at 46 degrees
    camera = Camera("c", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), "plumb_bob", lens)
    poses = [make_pose(np.eye(3), 2 * np.array([np.sin(a), 0.0, np.cos(a)])) for a in np.radians([20.0, 60.0])]
    found = list(tag_boxes(_MAKER.tag_poses(0, [([i], 0.1, pose) for i, pose in enumerate(poses)])))
    boxes = boxes_of_points(camera, np.array([f.points for f in found]))
    assert np.isfinite(boxes[0]).all()
    assert np.isnan(boxes[1]).all()


@pytest.mark.parametrize("vision", "14")
def test_camera_info_of_both_ros(makers, vision):
    info = makers[vision].camera_info(0, _FISHEYE, "eye")
    camera, frame_T_camera = camera_of(info, "eye", "/info", rectified=False)
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "equidistant")
    assert np.array_equal(camera.matrix, _K)
    assert np.array_equal(camera.distortion, _FISHEYE.distortion)
    assert np.array_equal(frame_T_camera, np.eye(4))


def test_a_rectified_image_is_not_undistorted_again(makers):
    turn = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    projection = np.array([[450.0, 0, 310, -45], [0, 450, 250, 0], [0, 0, 1, 0]])
    info = makers["4"].camera_info(0, _PLUMB, "eye", turn, projection)
    camera, frame_T_camera = camera_of(info, "eye", "/info", rectified=True)
    assert np.array_equal(camera.matrix, projection[:, :3])
    assert not camera.distortion.any()
    assert np.array_equal(frame_T_camera, np.eye(4))
    camera, frame_T_camera = camera_of(info, "eye", "/info", rectified=False)
    assert np.array_equal(camera.matrix, _K)
    np.testing.assert_allclose(frame_T_camera[:3, :3], turn)
    # one point of the world, by the raw and by the rectified image (cv2 as the second opinion): the same direction
    point = np.array([[[200.0, 150.0]]])
    raw = cv2.undistortPoints(point, _K, _PLUMB.distortion)[0, 0]
    rectified = cv2.undistortPoints(point, _K, _PLUMB.distortion, R=turn, P=projection[:, :3])[0, 0]
    by_raw = frame_T_camera[:3, :3] @ [*raw, 1]
    by_rectified = np.linalg.inv(projection[:, :3]) @ [*rectified, 1]
    np.testing.assert_allclose(by_raw / by_raw[2], by_rectified, atol=1e-9)


def test_binning_and_a_region_of_interest(makers):
    info = makers["4"].camera_info(0, _PLUMB, "eye", binning=2, region=(100, 40, 200, 400))
    camera, _ = camera_of(info, "eye", "/info", rectified=False)
    assert (camera.width, camera.height) == (200, 100)
    np.testing.assert_allclose(camera.matrix, [[250, 0, 110], [0, 255, 100], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k": np.zeros(9)}, "not calibrated"),
        ({"width": 0}, "not calibrated"),
        ({"width": 2**31}, "not calibrated"),
        ({"k": np.full(9, np.nan)}, "not calibrated"),
        ({"distortion_model": "omnidirectional"}, "unknown distortion_model 'omnidirectional'"),
        ({"d": np.array([0.1, 0.2])}, "takes 4 or 5 coefficients, got 2"),
        ({"d": np.array([0.1, 0.2, np.nan, 0.0, 0.0])}, "not finite"),
    ],
)
def test_a_calibration_that_is_none(makers, change, message):
    info = makers["4"].camera_info(0, _PLUMB, "eye")
    for name, value in change.items():
        setattr(info, name, value)
    with pytest.raises(LogError, match=message) as caught:
        camera_of(info, "eye", "/info", rectified=False)
    assert caught.value.where == "/info"


def test_other_spellings_and_cameras_without_distortion(makers):
    info = makers["4"].camera_info(0, _FISHEYE, "eye")
    info.distortion_model = "fisheye"
    assert camera_of(info, "eye", "/info", rectified=False)[0].distortion_model == "equidistant"
    info.distortion_model, info.d = "", np.zeros(0)
    assert not camera_of(info, "eye", "/info", rectified=False)[0].distortion.any()
    info.p = np.zeros(12)
    assert np.array_equal(camera_of(info, "eye", "/info", rectified=True)[0].matrix, _K)


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40), st.integers(0, 2**31 * 10**9 - 1))
def test_the_head_of_a_message_in_both_encodings(frame, stamp):
    for maker, encoding in ((_MAKER, "cdr"), (_OLD, "ros1")):
        data = serialize(maker, maker.detections(stamp, [(0, 0, 1, 1, 1, 1)] * 3, frame))
        assert read_head(data, encoding) == (stamp, frame, 3)


_OLD = Maker("1")


def test_big_endian_cdr():
    store = _MAKER.store
    message = _MAKER.detections(5 * 10**9 + 7, [(1, 2, 3, 4, "cup", 0.5)] * 2, "eye")
    data = bytes(store.serialize_cdr(message, message.__msgtype__, little_endian=False))
    assert read_head(data, "cdr") == (5 * 10**9 + 7, "eye", 2)
    decode = make_decoder(Connection("/d", message.__msgtype__, "cdr"))
    assert decode(data).detections[1].bbox.size_x == 2


@given(st.binary(max_size=60))
def test_any_bytes_for_a_head(data):
    for encoding in ("cdr", "ros1"):
        try:
            stamp, frame, number = read_head(data, encoding)
        except DecodeError:
            assert len(data) < 16 or int.from_bytes(data[12:16], "little" if encoding == "ros1" or data[1] else "big") > 0
        else:
            assert stamp >= 0
            assert len(frame) <= len(data)
            assert 0 <= number < 2**32
        assert read_length(data, encoding) >= 0


@given(st.binary(max_size=400))
def test_any_bytes_for_a_message(data):
    for name, decode in _DECODERS.items():
        try:
            message = decode(data)
        except DecodeError:
            continue
        assert message.__msgtype__ == name


_DECODERS = {
    name: make_decoder(Connection("/x", name, "cdr"))
    for name in ("vision_msgs/msg/Detection2DArray", "nav_msgs/msg/Odometry")
}


@pytest.mark.parametrize(
    ("connection", "message"),
    [
        (Connection("/x", "nav_msgs/msg/Odometry", "protobuf"), "encoded as 'protobuf'"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr"), "lacks the definition"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "float64[1000000000] x\n"), "too large"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "float64 x\n" * 30_000), "definition is too long"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "Other x\n"), "cannot be used"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "Thing x\n"), "cannot be used"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "import os"), "cannot be used"),
        (Connection("/x", "my_msgs/msg/Thing", "cdr", "module x {", "idl"), "cannot be used"),
    ],
)
def test_types_that_cannot_be_decoded(connection, message):
    with pytest.raises(DecodeError, match=message):
        make_decoder(connection)


def test_fields_have_exactly_the_names_that_are_read(makers):
    """Only the matrices of a camera have capitals, in ROS 1."""
    name = "geometry_msgs/msg/PoseStamped"
    text, _ = makers["1"].store.generate_msgdef(name)
    assert make_decoder(Connection("/x", name, "ros1", text))
    with pytest.raises(DecodeError, match=r"no usable field pose.position.x"):
        make_decoder(Connection("/x", name, "ros1", text.replace("float64 x", "float64 X")))


def test_type_names():
    assert type_name("nav_msgs/Odometry") == type_name("nav_msgs/msg/Odometry") == "nav_msgs/msg/Odometry"
    assert type_name("foxglove.Log") == "foxglove.Log"
    assert type_name("a/b/c/d") == "a/b/c/d"
