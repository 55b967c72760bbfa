"""Which topic is what: paths, cameras, choices, and what is said where something is missing."""

from types import SimpleNamespace

import numpy as np
import pytest
from bag_writer import write_bag
from scipy.spatial.transform import Rotation

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, lift_se2, make_pose
from objslam.errors import ConfigError, LogError
from objslam.io.camera_yaml import write_camera
from objslam.ros.messages.topic_types import ODOMETRY
from objslam.sources.ros_bag.info import describe
from objslam.sources.ros_bag.log import read_bag, unread_boxes
from objslam.sources.ros_bag.options import BagOptions

_S = 10**9
_OPTICAL = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.4]))
_CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
_FRAME = "front_optical_frame"


def _drive(seconds):
    """Poses of a robot that drives an arc."""
    t = np.atleast_1d(np.asarray(seconds, dtype=float))
    return lift_se2(np.stack([np.sin(t / 5), 1 - np.cos(t / 5), t / 5], axis=1))


class Bag:
    """Rows of a bag in the making; times in s."""

    def __init__(self, maker):
        self.maker, self.rows = maker, []

    def odometry(self, topic="/odom", times=range(11), frame="odom", child="base_link", move=lambda pose: pose):
        for t in times:
            pose = move(_drive(t)[0])
            self.rows.append((topic, int(t * _S), self.maker.odometry(int(t * _S), pose, frame, child)))
        return self

    def tf(self, parent, child, pose, times=(0,), static=False):
        """pose: (4, 4), or a function of the time."""
        for t in times:
            transform = parent, child, pose(t) if callable(pose) else pose
            self.rows.append(("/tf_static" if static else "/tf", int(t * _S), self.maker.tf(int(t * _S), transform)))
        return self

    def camera(self, topic="/front/camera_info", frame=_FRAME, camera=_CAMERA, **more):
        self.rows.append((topic, 0, self.maker.camera_info(0, camera, frame, **more)))
        return self

    def boxes(self, topic="/front/detections", frame=_FRAME, times=range(1, 10), label="cup"):
        for t in times:
            found = [(10 + t, 20, 110 + t, 60, label, 0.5)]
            self.rows.append((topic, int(t * _S), self.maker.detections(int(t * _S), found, frame)))
        return self

    def image(self, topic, frame=_FRAME, encoding="rgb8", times=(1, 2)):
        shape, dtype = {"rgb8": ((4, 6, 3), np.uint8), "16UC1": ((4, 6), np.uint16)}[encoding]
        for t in times:
            self.rows.append((topic, int(t * _S), self.maker.image(int(t * _S), np.full(shape, 9, dtype), encoding, frame)))
        return self

    def add(self, topic, t, message):
        self.rows.append((topic, int(t * _S), message))
        return self

    def write(self, folder):
        return write_bag(folder / "bag", "mcap-none", self.maker, sorted(self.rows, key=lambda row: row[1]))


@pytest.fixture
def bag(makers):
    """Odometry, a camera on the robot with detections."""
    return Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()


def _read(bag, folder, ledger=None, **options):
    return read_bag(bag.write(folder), ledger or Ledger(), BagOptions(**options))


def test_a_plain_bag(bag, tmp_path):
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger)
    assert not ledger.lines()
    assert log.localization is None
    np.testing.assert_allclose(log.odometry.poses, _drive(range(11)), atol=1e-12)
    (camera_log,) = log.cameras
    assert camera_log.camera.name == "front"
    np.testing.assert_allclose(camera_log.camera.base_T_camera, _OPTICAL, atol=1e-12)
    assert camera_log.detections.label_names == ("cup",)
    assert camera_log.rgb is camera_log.depth is camera_log.mount is None


def test_header_stamps_not_times_of_recording(makers, tmp_path):
    bag = Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()
    bag.rows = [(topic, stamp + 7 * _S, message) for topic, stamp, message in bag.rows]
    log = _read(bag, tmp_path)
    assert log.odometry.stamps.tolist() == list(range(11))
    assert log.cameras[0].detections.frame_stamps.tolist() == list(range(1, 10))


def test_times_of_recording_where_nobody_set_the_stamps(bag, makers, tmp_path):
    bag.rows = [row for row in bag.rows if "detections" not in row[0]]
    for t in range(1, 10):
        bag.add("/front/detections", t, makers["4"].detections(0, [(0, 1, 2, 3, "cup", 0.5)], _FRAME))
    ledger = Ledger()
    assert _read(bag, tmp_path, ledger).cameras[0].detections.frame_stamps.tolist() == list(range(1, 10))
    (warning,) = ledger.warnings
    assert warning.startswith("/front/detections: all header stamps are zero. The times of recording are used instead")


def test_base_is_what_the_odometry_moves_unless_it_is_given(bag, tmp_path):
    foot = make_pose(np.eye(3), np.array([0.0, 0.0, 0.2]))
    bag.tf("base_footprint", "base_link", foot, static=True)
    assert describe(bag.write(tmp_path)).base == "base_link"
    log = _read(bag, tmp_path, base_frame="base_footprint")
    np.testing.assert_allclose(log.odometry.poses, _drive(range(11)) @ np.linalg.inv(foot), atol=1e-12)
    np.testing.assert_allclose(log.cameras[0].camera.base_T_camera, foot @ _OPTICAL, atol=1e-12)


def test_the_odometry_moves_a_frame_that_tf_does_not_know(makers, tmp_path):
    bag = Bag(makers["4"]).odometry(child="vio_body").tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger)
    assert "'vio_body', which is not in tf; 'base_link' is used instead" in ledger.warnings[0]
    np.testing.assert_allclose(log.cameras[0].camera.base_T_camera, _OPTICAL, atol=1e-12)


def test_odometry_out_of_tf(makers, tmp_path):
    bag = Bag(makers["4"]).tf("odom", "base_footprint", lambda t: _drive(t)[0], times=np.arange(0, 10, 0.5))
    bag.tf("base_footprint", "base_link", make_pose(np.eye(3), np.array([0, 0, 0.1])), static=True)
    bag.tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()
    path = bag.write(tmp_path)
    info = describe(path)
    assert (info.odometry, info.base) == ("tf odom -> base_footprint", "base_footprint")
    log = read_bag(path, Ledger())
    assert log.localization is None
    np.testing.assert_allclose(log.odometry.poses, _drive(np.arange(0, 10, 0.5)), atol=1e-12)


def _correction(t):
    return make_pose(Rotation.from_euler("z", 0.01 * t).as_matrix(), np.array([0.02 * t, -0.01 * t, 0]))


def test_localisation_is_map_to_odom_with_the_odometry(bag, tmp_path):
    times = np.arange(2, 9, 1.5)
    bag.tf("map", "odom", _correction, times=times)
    log = _read(bag, tmp_path)
    inside = np.arange(2, 9)
    assert log.localization.stamps.tolist() == inside[inside <= times[-1]].tolist()
    corrections, _ = interpolate(times, np.array([_correction(t) for t in times]), log.localization.stamps, 10.0)
    expected = corrections @ _drive(log.localization.stamps)
    np.testing.assert_allclose(log.localization.poses, expected, atol=1e-12)
    assert len(log.odometry) == 11
    assert describe(bag.write(tmp_path)).localization == "tf map -> odom with /odom"


def test_a_map_that_never_moves_is_no_localisation(bag, tmp_path):
    still = _correction(20)
    log = _read(bag.tf("map", "odom", still, times=range(11)), tmp_path)
    assert log.localization is None
    np.testing.assert_allclose(log.odometry.poses, still @ _drive(range(11)), atol=1e-12)


def test_a_map_without_odometry(makers, tmp_path):
    bag = Bag(makers["4"]).tf("map", "base_link", lambda t: _drive(t)[0], times=range(11))
    bag.tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()
    log = _read(bag, tmp_path)
    assert log.odometry is None
    np.testing.assert_allclose(log.localization.poses, _drive(range(11)), atol=1e-12)


@pytest.mark.parametrize("covariance", [True, False])
def test_poses_in_map_but_not_goals(bag, makers, tmp_path, covariance):
    for t in range(0, 10, 3):
        pose = makers["4"].pose_stamped(t * _S, _correction(t), covariance=covariance)
        bag.add("/localization/pose", t, pose).add("/goal_pose", t, makers["4"].pose_stamped(t * _S, _drive(t)[0]))
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger)
    assert not ledger.lines()
    assert log.localization.stamps.tolist() == [0, 3, 6, 9]
    np.testing.assert_allclose(log.localization.poses[1], _correction(3), atol=1e-12)
    chosen = _read(bag, tmp_path, topics=("localization=/goal_pose",))
    np.testing.assert_allclose(chosen.localization.poses[1], _drive(3)[0], atol=1e-12)
    assert _read(bag, tmp_path, topics=("localization=none",)).localization is None


def test_odometry_in_map_is_localisation(makers, tmp_path):
    """As visual SLAM and motion capture give it; there is no tf of the robot at all."""
    write_camera(_CAMERA, tmp_path / "camera.yaml")
    bag = Bag(makers["4"]).odometry("/slam/odometry", frame="map", child="rig").boxes()
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger, camera_info=tmp_path / "camera.yaml")
    assert not ledger.lines()
    assert log.odometry is None
    np.testing.assert_allclose(log.localization.poses, _drive(range(11)), atol=1e-12)
    chosen = _read(
        bag, tmp_path, camera_info=tmp_path / "camera.yaml", topics=("odometry=/slam/odometry", "localization=none")
    )
    assert chosen.localization is None
    assert len(chosen.odometry) == 11


def test_of_several_that_fit_one_is_taken_and_all_are_listed(bag, tmp_path):
    bag.odometry("/odometry/filtered", move=lambda pose: pose @ _correction(5))
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger)
    np.testing.assert_allclose(log.odometry.poses, _drive(range(11)), atol=1e-12)
    assert ledger.warnings == ["several fit odometry: /odom is taken, not /odometry/filtered (--topic odometry=... chooses)"]
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger, topics=("odometry=/odometry/filtered",))
    np.testing.assert_allclose(log.odometry.poses, _drive(range(11)) @ _correction(5), atol=1e-12)
    assert not ledger.lines()


def _moved(shift):
    return make_pose(np.eye(3), np.array([shift, 0, 0]))


def _robot(maker, space, shift):
    """A robot in a namespace, whose frames have the names of any other robot.

    Its map lies `shift` m from its odometry, which begins `shift` m from its start.
    """
    bag = Bag(maker).odometry(move=lambda pose: _moved(shift) @ pose).camera().boxes(label=space[1:])
    bag.tf("base_link", _FRAME, _OPTICAL, static=True)
    bag.tf("map", "odom", lambda t: _moved(shift) @ make_pose(np.eye(3), np.array([0, t, 0])), times=range(11))
    bag.tf("odom", "base_link", lambda t: _moved(shift) @ _drive(t)[0], times=range(11))
    return [(space + topic, stamp, message) for topic, stamp, message in bag.rows]


@pytest.mark.parametrize(("topics", "robot"), [((), 1), (("odometry=/r2/odom",), 2), (("tf=/r2/tf",), 2)])
def test_robots_in_namespaces_do_not_share_their_topics(makers, tmp_path, topics, robot):
    bag = Bag(makers["4"])
    bag.rows = _robot(makers["4"], "/r1", 3) + _robot(makers["4"], "/r2", 8)
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger, topics=topics)
    shift, other = (3, 2) if robot == 1 else (8, 1)
    np.testing.assert_allclose(log.odometry.poses[:, 0, 3], _drive(range(11))[:, 0, 3] + shift, atol=1e-9)
    np.testing.assert_allclose(log.localization.poses[:, 0, 3], _drive(range(11))[:, 0, 3] + 2 * shift, atol=1e-9)
    assert [camera.detections.label_names for camera in log.cameras] == [(f"r{robot}",)]
    warning = f"several fit tf: /r{robot}/tf is taken, not /r{other}/tf (--topic tf=... chooses)"
    assert ledger.warnings == ([] if "tf=/r2/tf" in topics else [warning])
    used = {topic.name for topic in describe(bag.write(tmp_path), BagOptions(topics=topics)).topics if topic.role}
    assert used == {name for name, *_ in bag.rows if name.startswith(f"/r{robot}/")}


def test_transforms_of_one_robot_on_several_topics_belong_together(makers, tmp_path):
    """A relay on /tf repeats half of the transforms. Or the static transforms are on /tf_static, without a namespace."""
    rows = _robot(makers["4"], "/r1", 3)
    relay = [("/tf", stamp, message) for topic, stamp, message in rows if topic == "/r1/tf"][::2]
    apart = [("/tf_static" if "static" in topic else topic, stamp, message) for topic, stamp, message in rows]
    bag, expected = Bag(makers["4"]), _drive(range(11))[:, 0, 3] + 6
    for bag.rows in (rows + relay, apart):
        ledger = Ledger()
        np.testing.assert_allclose(_read(bag, tmp_path, ledger).localization.poses[:, 0, 3], expected, atol=1e-9)
        assert not ledger.lines()


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("odometry", "is not role=/name"),
        ("laser=/scan", "is not role=/name.*roles: odometry"),
        ("odometry=/wheels", r"/wheels is not in the bag.*topics that fit odometry: /odom"),
        ("detections=/odom", r"/odom has the type nav_msgs/msg/Odometry.*fit detections: /front/detections"),
        ("detections=tf", "tf is not in the bag"),
    ],
)
def test_a_choice_that_does_not_fit(bag, tmp_path, choice, message):
    with pytest.raises(ConfigError, match=message):
        _read(bag, tmp_path, topics=(choice,))


def _two_cameras(bag):
    left = make_pose(_OPTICAL[:3, :3], np.array([0.1, 0.3, 0.4]))
    bag.tf("base_link", "left_optical_frame", left, static=True)
    bag.camera("/left/camera_info", "left_optical_frame").boxes("/left/detections", "left_optical_frame", label="mug")
    return left


def test_two_cameras_by_their_frames(bag, tmp_path):
    left = _two_cameras(bag)
    log = _read(bag, tmp_path)
    by_name = {c.camera.name: c for c in log.cameras}
    assert sorted(by_name) == ["front", "left"]
    np.testing.assert_allclose(by_name["left"].camera.base_T_camera, left, atol=1e-12)
    assert by_name["left"].detections.label_names == ("mug",)
    roles = {topic.name: topic.role for topic in describe(bag.write(tmp_path)).topics}
    assert roles == {
        "/front/camera_info": "front.camera_info", "/front/detections": "front.detections", "/odom": "odometry",
        "/left/camera_info": "left.camera_info", "/left/detections": "left.detections", "/tf_static": "tf_static",
    }  # fmt: skip
    (only,) = _read(bag, tmp_path, topics=("detections=/left/detections",)).cameras
    assert only.camera.name == "left"


def test_a_camera_without_a_place_is_left_out_if_there_are_others(bag, tmp_path):
    bag.camera("/left/camera_info", "left_optical_frame").boxes("/left/detections", "left_optical_frame")
    ledger = Ledger()
    (only,) = _read(bag, tmp_path, ledger).cameras
    assert only.camera.name == "front"
    assert "tf does not connect 'base_link' and 'left_optical_frame'" in ledger.warnings[0]
    assert any("left_optical_frame" in line for line in describe(bag.write(tmp_path)).missing)


def test_a_detector_that_names_another_frame_gets_the_only_calibration(makers, tmp_path):
    bag = Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True).camera()
    (camera_log,) = _read(bag.boxes("/yolo/detections", frame=""), tmp_path).cameras
    np.testing.assert_allclose(camera_log.camera.base_T_camera, _OPTICAL, atol=1e-12)


def test_a_camera_that_moves_on_the_robot(makers, tmp_path):
    def turn(t):
        return make_pose(Rotation.from_euler("z", 0.1 * t).as_matrix(), np.array([0, 0, 0.5]))

    bag = Bag(makers["4"]).odometry().tf("base_link", "pan", turn, times=range(11))
    bag.tf("pan", _FRAME, _OPTICAL, static=True).camera().boxes()
    (camera_log,) = _read(bag, tmp_path).cameras
    assert camera_log.mount.stamps.tolist() == list(range(11))
    np.testing.assert_allclose(camera_log.mount.poses, [turn(t) @ _OPTICAL for t in range(11)], atol=1e-12)
    assert describe(bag.write(tmp_path)).places[0].base_T_frame is None


def test_images_of_a_camera_raw_before_rectified(makers, tmp_path):
    plumb = Camera("front", 6, 4, _CAMERA.matrix, distortion=np.array([-0.2, 0.1, 0, 0, 0]))
    bag = Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True)
    projection = np.diag([0.9, 0.9, 1.0]) @ np.column_stack([_CAMERA.matrix, np.zeros(3)])
    bag.camera("/front/color/camera_info", camera=plumb, projection=projection)
    bag.image("/front/color/image_raw").image("/front/color/image_rect").image("/front/depth/image", encoding="16UC1")
    bag.image("/far/depth/image", "far_optical_frame", encoding="16UC1")
    ledger = Ledger()
    (camera_log,) = _read(bag, tmp_path, ledger, extract=tmp_path / "images").cameras
    assert "several fit front.image: /front/color/image_raw is taken, not /front/color/image_rect" in ledger.warnings[0]
    assert camera_log.camera.distortion.tolist() == plumb.distortion.tolist()
    assert camera_log.rgb.stamps.tolist() == camera_log.depth.stamps.tolist() == [1, 2]
    assert camera_log.rgb.paths[0].relative_to(tmp_path).as_posix() == "images/front/rgb/1.000000000.png"
    (camera_log,) = _read(bag, tmp_path, topics=("image=/front/color/image_rect",), with_images=False).cameras
    assert not camera_log.camera.distortion.any()
    assert camera_log.camera.matrix[0, 0] == 450
    assert camera_log.rgb is None
    (camera_log,) = _read(bag, tmp_path, rectified=True, with_images=False).cameras
    assert camera_log.camera.matrix[0, 0] == 450


def test_a_calibration_file_stands_in(makers, tmp_path):
    bag = Bag(makers["4"]).odometry(child="rig").boxes("/rig/front/tags", "x").boxes("/rig/left/tags", "y", label="mug")
    left = Camera("left", 640, 480, _CAMERA.matrix, "equidistant", np.zeros(4), make_pose(np.eye(3), np.ones(3)))
    write_camera(left, tmp_path / "left.yaml")
    text = "\n".join("    " + line for line in (tmp_path / "left.yaml").read_text().splitlines())
    file = tmp_path / "cameras.yaml"
    file.write_text(f"cameras:\n  left:\n{text}\n")
    ledger = Ledger()
    (camera_log,) = _read(bag, tmp_path, ledger, camera_info=file, topics=("left.detections=/rig/front/tags",)).cameras
    assert camera_log.detections.label_names == ("cup",)
    ledger = Ledger()
    (camera_log,) = _read(bag, tmp_path, ledger, camera_info=file).cameras
    assert camera_log.detections.label_names == ("mug",)
    assert camera_log.camera.distortion_model == "equidistant"
    np.testing.assert_allclose(camera_log.camera.base_T_camera, left.base_T_camera, atol=1e-12)
    assert ledger.warnings == ["/rig/front/tags: left out, because no calibration has a fitting name (left)"]


@pytest.mark.parametrize("text", ["{}", "camera_name: front\n{}", "cameras: {{front: {{{}}}}}"])
def test_a_file_of_a_mount_alone_leaves_the_lens_to_camera_info(makers, tmp_path, text):
    """A bag without tf of its camera: the file says where it sits."""
    bag = Bag(makers["4"]).odometry(child="rig").boxes("/front/tags").camera()
    with pytest.raises(LogError, match="tf"):
        _read(bag, tmp_path)
    mount = "base_T_camera: {translation: [1.0, 2.0, 3.0], rotation_xyzw: [0.0, 0.0, 0.0, 1.0]}"
    (tmp_path / "mount.yaml").write_text(text.format(mount))
    (camera_log,) = _read(bag, tmp_path, camera_info=tmp_path / "mount.yaml").cameras
    np.testing.assert_allclose(camera_log.camera.matrix, _CAMERA.matrix)
    np.testing.assert_allclose(camera_log.camera.base_T_camera[:, 3], [1, 2, 3, 1])


def test_a_calibration_file_without_a_place_leaves_that_to_tf(makers, tmp_path):
    bag = Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True).boxes()
    write_camera(_CAMERA, tmp_path / "camera.yaml")
    lines = (tmp_path / "camera.yaml").read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("base_T_camera"))
    kept = lines[:start] + [line for line in lines[start + 1 :] if not line.startswith(" ")]
    (tmp_path / "camera.yaml").write_text("\n".join(kept))
    (camera_log,) = _read(bag, tmp_path, camera_info=tmp_path / "camera.yaml").cameras
    np.testing.assert_allclose(camera_log.camera.base_T_camera, _OPTICAL, atol=1e-12)


@pytest.mark.parametrize(
    ("without", "message"),
    [
        ("/odom", "neither odometry nor localisation"),
        ("/front/camera_info", "no CameraInfo belongs to this camera"),
        ("/front/detections", "no camera: the recording has no images and no detections"),
        ("/tf_static", r"'base_link' is in no transform; 'front_optical_frame' is in no transform.*record /tf_static"),
    ],
)
def test_what_is_missing_is_named(bag, tmp_path, without, message):
    bag.rows = [row for row in bag.rows if row[0] != without]
    path = bag.write(tmp_path)
    with pytest.raises(LogError, match=message):
        read_bag(path, Ledger())
    assert any(message.split(".*")[0] in line for line in describe(path).missing)


def test_topics_with_boxes_of_other_types_are_named():
    """`yolo_msgs/DetectionArray` is common."""
    types = {"/yolo": "yolo_msgs/msg/DetectionArray", "/boxes": "vision_msgs/msg/Detection2DArray", "/odom": ODOMETRY}
    topics = {name: SimpleNamespace(name=name, type=type_) for name, type_ in types.items()}
    advice = unread_boxes(SimpleNamespace(topics=topics))
    assert advice.startswith("/yolo has yolo_msgs/msg/DetectionArray, which is not read")
    assert "/boxes" not in advice
    topics.pop("/yolo")
    assert unread_boxes(SimpleNamespace(topics=topics)) == ""


def test_a_map_without_odometry_in_tf_is_named_and_the_base_is_still_found(makers, tmp_path):
    bag = Bag(makers["4"]).tf("base_link", _FRAME, _OPTICAL, static=True).camera().boxes()
    info = describe(bag.tf("map", "odom", _correction, times=range(11)).write(tmp_path))
    (line,) = info.missing
    assert "neither odometry nor localisation: tf has 'odom', but not its transform to 'base_link'" in line
    assert info.base == "base_link"
    np.testing.assert_allclose(info.cameras[0].base_T_camera, _OPTICAL, atol=1e-12)


def test_boxes_without_a_frame_say_so(makers, tmp_path):
    bag = Bag(makers["4"]).odometry().tf("base_link", _FRAME, _OPTICAL, static=True).camera(frame="").boxes(frame="")
    with pytest.raises(LogError, match="its messages have no frame_id, so tf cannot place it") as caught:
        _read(bag, tmp_path)
    assert "--camera-info" in caught.value.hint


def test_stamps_that_go_back_are_dropped(bag, makers, tmp_path):
    for t in (3, 4):
        bag.rows.append(("/odom", 20 * _S, makers["4"].odometry(t * _S, _drive(t)[0])))
        bag.rows.append(("/front/detections", 20 * _S, makers["4"].detections(t * _S, [(0, 0, 1, 1, "cup", 1)], _FRAME)))
    ledger = Ledger()
    log = _read(bag, tmp_path, ledger)
    assert len(log.odometry) == 11
    assert ledger.dropped == {
        "odometry message with a stamp that repeats or goes back": 2,
        "detection frame with a stamp that repeats or goes back": 2,
    }
