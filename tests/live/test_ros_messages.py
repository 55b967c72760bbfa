"""What is pushed for the messages of a robot that is simulated here, with the truth known."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker
from robot import BASE_T_CAMERA, MAP_T_ODOM, Recorder, pose_at

from objslam.core.camera import Camera
from objslam.errors import ConfigError
from objslam.io.camera_yaml import write_camera
from objslam.live.ros.message_handler import RosMessages
from objslam.ros.topics import parse_topics
from objslam.sources.ros_bag.options import RosOptions

ODOMETRY, TF, DETECTIONS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "vision_msgs/msg/Detection2DArray"
INFO, POSE = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseWithCovarianceStamped"
OPTICAL = "front_optical_frame"
CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
for array in (CAMERA.matrix, CAMERA.distortion, CAMERA.base_T_camera):
    array.setflags(write=False)  # All tests share it.
BOXES = [(100, 120, 140, 180, "cup", 0.9, "7"), (300, 200, 340, 260, "", 0.5, "left")]


@pytest.fixture(scope="module")
def maker():
    return Maker()


class Robot:
    """Sends messages to a recorder; time only passes when a test says so."""

    def __init__(self, maker, **options):
        self.make, self.sink, self.now = maker, Recorder(), 0.0
        self.messages = RosMessages(self.sink, RosOptions(**options), clock=lambda: self.now)

    def send(self, type_, topic, message, received=1.0):
        self.messages.receive(type_, topic, message, received)

    def odometry(self, t, pose=None, topic="/odom", **frames):
        self.send(ODOMETRY, topic, self.make.odometry(ns(t), pose_at(t) if pose is None else pose, **frames))

    def tf(self, t, *transforms, static=False):
        self.send(TF, "/tf_static" if static else "/tf", self.make.tf(ns(t), *transforms))

    def info(self, t=0.0, camera=CAMERA, frame=OPTICAL, topic="/front/camera_info"):
        self.send(INFO, topic, self.make.camera_info(ns(t), camera, frame))

    def detections(self, t, boxes=BOXES, frame=OPTICAL, topic="/front/detections"):
        self.send(DETECTIONS, topic, self.make.detections(ns(t), boxes, frame))

    @property
    def dropped(self):
        return self.messages.ledger.dropped


def ns(t):
    return round(t * 1e9)


def planar(x, yaw):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[0, 3] = x
    return pose


def test_odometry_and_localisation_by_tf(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(1.1, ("map", "odom", MAP_T_ODOM))
    robot.odometry(1.2)
    robot.tf(1.3, ("map", "odom", MAP_T_ODOM))  # a repetition says nothing new
    robot.odometry(1.4)
    moved = MAP_T_ODOM @ planar(0.1, 0.01)
    robot.tf(1.5, ("map", "odom", moved))
    robot.odometry(1.6)
    stamps = [stamp for stamp, *_ in robot.sink.odometry]
    assert stamps == pytest.approx([1.0, 1.2, 1.4, 1.6])
    np.testing.assert_allclose([pose for _, pose, *_ in robot.sink.odometry], [pose_at(t) for t in stamps], atol=1e-9)
    assert all(covariance is None for _, _, covariance, _ in robot.sink.odometry)  # it was left zero
    (first, a, _), (second, b, _) = robot.sink.localization
    assert (first, second) == pytest.approx((1.2, 1.6))
    np.testing.assert_allclose(a, MAP_T_ODOM @ pose_at(1.2), atol=1e-9)
    np.testing.assert_allclose(b, moved @ pose_at(1.6), atol=1e-9)
    assert not robot.dropped


def test_a_static_map_frame_is_pushed_once(maker):
    robot = Robot(maker)
    robot.tf(0.0, ("map", "odom", MAP_T_ODOM), static=True)
    for t in (1.0, 1.1, 1.2):
        robot.odometry(t)
    ((stamp, pose, _),) = robot.sink.localization
    assert stamp == pytest.approx(1.0)
    np.testing.assert_allclose(pose, MAP_T_ODOM @ pose_at(1.0), atol=1e-9)


def test_covariance_is_handed_on_where_somebody_filled_it_in(maker):
    robot = Robot(maker)
    message = maker.odometry(ns(1.0), pose_at(1.0))
    message.pose.covariance[:] = (np.arange(36) + 1) / 100
    robot.send(ODOMETRY, "/odom", message)
    np.testing.assert_array_equal(robot.sink.odometry[0][2], (np.arange(36).reshape(6, 6) + 1) / 100)
    message.pose.covariance[3] = np.nan
    robot.send(ODOMETRY, "/odom", message)
    assert robot.sink.odometry[1][2] is None


def test_odometry_of_another_part_of_the_robot_is_moved_to_base(maker):
    robot = Robot(maker, base_frame="base_link")
    wheel_T_base = planar(0.3, 0.2)
    robot.tf(0.0, ("wheel", "base_link", wheel_T_base), static=True)
    robot.odometry(1.0, child="wheel")
    np.testing.assert_allclose(robot.sink.odometry[0][1], pose_at(1.0) @ wheel_T_base, atol=1e-9)


def test_tf_stands_in_for_odometry_after_a_while_but_a_topic_comes_first(maker):
    robot = Robot(maker)
    robot.tf(0.0, ("base_footprint", "base_link", planar(0.2, 0)), static=True)
    for k in range(20):
        robot.now = 0.2 * k
        robot.tf(10 + 0.2 * k, ("odom", "base_footprint", pose_at(k)))
    assert robot.sink.odometry[0][0] > 12.0
    stamps = [stamp for stamp, *_ in robot.sink.odometry]
    assert stamps == pytest.approx([10 + 0.2 * k for k in range(20) if 0.2 * k > 2.0])
    np.testing.assert_allclose(robot.sink.odometry[-1][1], pose_at(19), atol=1e-9)

    robot = Robot(maker)
    for k in range(20):
        robot.now = 0.2 * k
        robot.tf(10 + 0.2 * k, ("odom", "base_link", pose_at(k)))
        if k == 5:
            robot.odometry(11.0)
    assert len(robot.sink.odometry) == 1


def test_tf_gives_the_odometry_at_once_where_a_user_says_so(maker):
    robot = Robot(maker, topics=("odometry=tf",))
    robot.odometry(1.0)
    robot.tf(1.1, ("odom", "base_link", pose_at(1.1)))
    robot.tf(1.2, ("odom", "base_link", pose_at(1.1)))  # standing still is news as well
    assert [stamp for stamp, *_ in robot.sink.odometry] == pytest.approx([1.1, 1.2])
    assert robot.dropped == {"odometry from a second topic": 1}


def test_a_pose_in_map_is_localisation(maker):
    robot = Robot(maker)
    robot.odometry(1.0, frame="map", topic="/ground_pose")
    assert not robot.sink.odometry
    np.testing.assert_allclose(robot.sink.localization[0][1], pose_at(1.0), atol=1e-9)

    robot = Robot(maker, topics=("localization=/amcl_pose",))
    for topic in ("/amcl_pose", "/goal_pose"):
        robot.send(POSE, topic, maker.pose_stamped(ns(2.0), pose_at(2.0)))
    robot.tf(2.1, ("map", "odom", MAP_T_ODOM))  # not chosen
    robot.odometry(2.2)
    ((stamp, pose, _),) = robot.sink.localization
    assert stamp == pytest.approx(2.0)
    np.testing.assert_allclose(pose, pose_at(2.0), atol=1e-9)


def test_localisation_without_odometry_comes_from_tf(maker):
    robot = Robot(maker)
    for k in range(5):
        robot.tf(10 + 0.1 * k, ("world", "base_link", pose_at(k)))
    assert [stamp for stamp, *_ in robot.sink.localization] == pytest.approx([10 + 0.1 * k for k in range(5)])
    np.testing.assert_allclose(robot.sink.localization[-1][1], pose_at(4), atol=1e-9)


def test_a_camera_is_pushed_once_it_is_calibrated_and_placed(maker):
    robot = Robot(maker, label="thing")
    robot.odometry(1.0)
    robot.detections(1.1)
    robot.info()
    assert not robot.sink.cameras
    robot.now = 0.5
    mast = planar(0.4, 0.3)
    mast_T_optical = np.linalg.inv(mast) @ BASE_T_CAMERA
    robot.tf(0.0, ("base_link", "mast", mast), ("mast", OPTICAL, mast_T_optical), static=True)
    robot.detections(1.2)
    robot.detections(1.3, boxes=[])
    (camera,) = robot.sink.cameras
    np.testing.assert_allclose(camera.base_T_camera, BASE_T_CAMERA, atol=1e-9)
    np.testing.assert_array_equal(camera.matrix, CAMERA.matrix)
    assert (camera.name, camera.width, camera.height) == ("front", 640, 480)
    assert [stamp for stamp, *_ in robot.sink.detections] == pytest.approx([1.1, 1.2, 1.3])  # the one that waited is first
    _, name, boxes, labels, scores, tracks, _ = robot.sink.detections[0]
    assert name == "front"
    np.testing.assert_allclose(boxes, [box[:4] for box in BOXES])
    assert labels == ["cup", "thing"]
    np.testing.assert_allclose(scores, [0.9, 0.5])
    assert tracks[0] == 7
    assert tracks[1] >= 10**18
    assert len(robot.sink.detections[2][2]) == 0
    assert not robot.sink.mounts
    assert not robot.dropped


def test_boxes_whose_camera_never_comes_are_dropped_and_say_why(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.detections(1.1)
    robot.now = 0.9
    robot.messages.tick()
    assert not robot.dropped
    robot.now = 1.1
    robot.messages.tick()
    assert robot.dropped == {"detection frame of a camera without calibration or transform": 1}
    (line,) = robot.messages.ledger.lines()
    assert "no CameraInfo has the frame 'front_optical_frame'" in line


def test_a_camera_that_moves_is_placed_at_each_image(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.info()
    robot.tf(0.0, ("head", OPTICAL, BASE_T_CAMERA), static=True)
    for k in range(4):
        robot.tf(1.0 + 0.1 * k, ("base_link", "head", planar(0.0, 0.2 * k)))
    robot.detections(1.15)
    robot.detections(1.35)  # after the newest transform: it waits
    robot.detections(1.36)
    assert [stamp for stamp, *_ in robot.sink.detections] == pytest.approx([1.15])
    robot.tf(1.4, ("base_link", "head", planar(0.0, 0.8)))
    assert [stamp for stamp, *_ in robot.sink.detections] == pytest.approx([1.15, 1.35, 1.36])
    places = [robot.sink.cameras[0].base_T_camera, *(pose for _, _, pose in robot.sink.mounts)]
    np.testing.assert_allclose(places, [planar(0.0, yaw) @ BASE_T_CAMERA for yaw in (0.3, 0.7, 0.72)], atol=1e-9)
    assert [stamp for stamp, *_ in robot.sink.mounts] == pytest.approx([1.35, 1.36])


def test_a_calibration_that_changes_is_pushed_anew(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), static=True)
    for k in range(3):
        robot.info(k)
        robot.detections(1.1 + k)
    zoomed = Camera("front", 640, 480, CAMERA.matrix * [[2], [2], [1]])
    robot.info(4, zoomed)
    robot.detections(5.0)
    assert [camera.matrix[0, 0] for camera in robot.sink.cameras] == [500, 1000]


def test_a_calibration_file_takes_the_place_of_camera_info(maker, tmp_path):
    write_camera(Camera("kinect", 640, 480, CAMERA.matrix, base_T_camera=BASE_T_CAMERA), tmp_path / "kinect.yaml")
    robot = Robot(maker, camera_info=tmp_path / "kinect.yaml")
    robot.detections(1.0, frame="")
    assert robot.sink.cameras[0].name == "kinect"
    np.testing.assert_allclose(robot.sink.cameras[0].base_T_camera, BASE_T_CAMERA)
    assert robot.sink.detections[0][1] == "kinect"


def test_a_file_of_a_mount_alone_leaves_the_lens_to_camera_info(maker, tmp_path):
    """A robot without tf of its camera: the file says where it sits."""
    (tmp_path / "mount.yaml").write_text(
        "base_T_camera: {translation: [1.0, 2.0, 3.0], rotation_xyzw: [0.0, 0.0, 0.0, 1.0]}"
    )
    robot = Robot(maker, camera_info=tmp_path / "mount.yaml")
    robot.odometry(1.0)
    robot.info()
    robot.detections(1.1)
    (camera,) = robot.sink.cameras
    np.testing.assert_allclose(camera.matrix, CAMERA.matrix)
    np.testing.assert_allclose(camera.base_T_camera[:, 3], [1, 2, 3, 1])
    assert len(robot.sink.detections) == 1


def test_the_nearest_camera_info_serves_boxes_of_a_frame_of_their_own(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), ("base_link", "rear", np.eye(4)), static=True)
    robot.info()
    robot.info(camera=Camera("rear", 320, 240, CAMERA.matrix / 2), frame="rear", topic="/rear/camera_info")
    robot.detections(1.1, frame="yolo")
    assert not robot.sink.detections
    robot.now = 0.6
    robot.messages.tick()
    assert robot.sink.cameras[0].width == 640
    np.testing.assert_allclose(robot.sink.cameras[0].base_T_camera, BASE_T_CAMERA, atol=1e-9)
    assert len(robot.sink.detections) == 1


def test_two_detectors_on_one_camera_do_not_count_twice(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), static=True)
    robot.info()
    robot.detections(1.1)
    robot.detections(1.1, topic="/front/tracked")
    assert len(robot.sink.detections) == 1
    assert robot.dropped == {"detection frame from a second topic of its camera": 1}


def test_depth_images_give_boxes_their_depth(maker):
    robot = Robot(maker, topics=("depth=/front/depth",))
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), static=True)
    robot.info()
    robot.detections(1.0)
    millimetres = np.full((480, 640), 2500, np.uint16)
    millimetres[:, 250:] = 0
    metres = np.full((480, 640), np.nan, np.float32)
    metres[:, 250:] = 1.5

    def depth(t, array, encoding):
        robot.send("sensor_msgs/msg/Image", "/front/depth", maker.image(ns(t), array, encoding, OPTICAL))

    depth(1.1, millimetres, "16UC1")
    robot.detections(1.11)
    robot.detections(1.3)  # before its depth image: it waits
    assert len(robot.sink.detections) == 2
    depth(1.3, metres, "32FC1")
    depth(1.4, millimetres[::2], "16UC1")
    robot.detections(1.4)
    assert robot.sink.depths[0] is None
    np.testing.assert_allclose(robot.sink.depths[1:], [[2.5, np.nan], [np.nan, 1.5], [np.nan, np.nan]])
    robot.detections(1.5)
    robot.now = 0.3
    robot.messages.tick()
    assert len(robot.sink.detections) == 5
    assert robot.dropped == {
        "depth image that does not have the camera's size": 1,
        "depth of a frame without a depth image": 1,
    }


def test_april_tags_are_boxes(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), static=True)
    robot.info()
    corners = [(100, 100), (140, 100), (140, 140), (100, 140)]
    type_ = "apriltag_msgs/msg/AprilTagDetectionArray"
    robot.send(type_, "/tags", maker.tags(ns(1.1), [(5, corners)], OPTICAL))
    _, _, boxes, labels, scores, tracks, _ = robot.sink.detections[0]
    np.testing.assert_allclose(boxes, [[100, 100, 140, 140]])
    assert (labels, scores.tolist(), tracks) == (["tag_5"], [1.0], None)
    robot.now = 0.1
    robot.detections(1.2, topic="/tags")  # a detector's boxes may be cut off by the image's edge, a fiducial's never
    assert robot.sink.whole == [True, False]

    robot = Robot(maker)
    robot.odometry(1.0)
    robot.tf(0.0, ("base_link", OPTICAL, BASE_T_CAMERA), static=True)
    robot.info()
    camera_T_tag = np.eye(4)
    camera_T_tag[:3, 3] = [0.2, 0.1, 2.0]
    message = maker.tag_poses(ns(1.1), [([3], 0.4, camera_T_tag)], OPTICAL)
    robot.send("apriltag_ros/msg/AprilTagDetectionArray", "/tags", message)
    (box,) = robot.sink.detections[0][2]
    np.testing.assert_allclose(box, [320, 215, 420, 315])  # 500 * (0.2, 0.1) / 2 + centre, 500 * 0.2 / 2 each way


def test_poses_that_are_none_are_counted(maker):
    robot = Robot(maker)
    robot.odometry(1.0)
    broken = maker.odometry(ns(1.1), np.eye(4))
    broken.pose.pose.position.x = np.nan
    robot.send(ODOMETRY, "/odom", broken)
    broken = maker.odometry(ns(1.2), np.eye(4))
    broken.pose.pose.orientation.w = 0.0
    robot.send(ODOMETRY, "/odom", broken)
    assert robot.dropped == {"odometry message without a valid pose (not finite or a zero quaternion)": 2}


def test_a_stamp_that_nobody_set_is_the_time_of_arrival(maker):
    robot = Robot(maker)
    robot.send(ODOMETRY, "/odom", maker.odometry(0, np.eye(4)), received=123.5)
    assert robot.sink.odometry[0][0] == 123.5


@pytest.mark.parametrize("text", ["odometry", "wheel=/odom", "image=tf", "odometry="])
def test_choices_that_cannot_be_are_wrong_use(text):
    with pytest.raises(ConfigError):
        parse_topics([text], live=True)


def test_choices_by_role():
    chosen = parse_topics(["odometry=odom", "detections=/a", "detections=/b", "localization=none"], live=True)
    assert [chosen.of(role) for role in ("odometry", "detections", "localization")] == [["/odom"], ["/a", "/b"], ["none"]]


finite = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=100)
@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("odometry"), finite, finite, st.sampled_from(["odom", "map", "", "base_link"])),
            st.tuples(st.just("tf"), finite, finite, st.sampled_from(["odom", "map", "", "base_link", OPTICAL])),
            st.tuples(st.just("boxes"), finite, finite, st.sampled_from([OPTICAL, "", "base_link"])),
            st.tuples(st.just("info"), finite, finite, st.sampled_from([OPTICAL, "", "base_link"])),
        ),
        max_size=30,
    )
)
def test_no_sequence_of_messages_breaks_it(maker, feed):
    robot = Robot(maker)
    for k, (kind, a, b, frame) in enumerate(feed):
        t, robot.now = 1.0 + 0.1 * k, 0.3 * k
        if kind == "odometry":
            message = maker.odometry(ns(t), np.eye(4), frame=frame)
            message.pose.pose.position.x, message.pose.pose.orientation.z = a, b
            robot.send(ODOMETRY, "/odom", message)
        elif kind == "tf":
            message = maker.tf(ns(t), (frame, "base_link" if k % 2 else OPTICAL, np.eye(4)))
            message.transforms[0].transform.translation.y = a
            message.transforms[0].transform.rotation.w = b
            robot.send(TF, "/tf", message)
        elif kind == "boxes":
            robot.detections(t, [(a, b, 10.0, 10.0, "cup", a)], frame=frame)
        else:
            message = maker.camera_info(ns(t), CAMERA, frame)
            message.k[0], message.d[0] = a, b
            robot.send(INFO, "/front/camera_info", message)
    for pose in [p for _, p, *_ in robot.sink.odometry + robot.sink.localization] + [p for _, _, p in robot.sink.mounts]:
        assert np.isfinite(pose).all()


def test_a_message_that_a_test_spoils_leaves_the_camera_alone(maker):
    camera = Camera("front", 640, 480, CAMERA.matrix.copy(), distortion=np.zeros(5))
    message = maker.camera_info(ns(1.0), camera, OPTICAL)
    message.k[0] = message.d[0] = 1e8
    np.testing.assert_array_equal(camera.matrix, CAMERA.matrix)
    assert not camera.distortion.any()
