"""A detector in a thread of its own, with images offered faster than it works."""

import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from robot import BASE_T_CAMERA, Recorder

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker

from objslam.detection import Boxes
from objslam.errors import DetectorError
from objslam.live.detector_worker import DetectorWorker
from objslam.live.ros_messages import RosMessages
from objslam.types import Camera

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA = Camera("front", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))
FRAME = "front_optical_frame"


class Brightest:
    """A detector that finds the brightest pixel of the red channel, when it is let go on."""

    def __init__(self):
        self.go = threading.Event()
        self.begun = threading.Event()

    def detect(self, images):
        (image,) = images
        self.begun.set()
        assert self.go.wait(20)
        red = image[:, :, 2]
        if not red.any():
            raise DetectorError("it is dark")
        y, x = np.unravel_index(red.argmax(), red.shape)
        return [Boxes(np.array([[x, y, x + 1.0, y + 1.0]]), ("spot",), np.array([0.75]))]


@pytest.fixture
def robot():
    maker, sink, detector = Maker(), Recorder(), Brightest()
    worker = DetectorWorker(detector, lambda: 0.0)
    messages = RosMessages(sink, detector=worker, clock=lambda: 0.0)
    messages.receive("nav_msgs/msg/Odometry", "/odom", maker.odometry(10**9, np.eye(4)), 1.0)
    tf = maker.tf(0, ("base_link", FRAME, BASE_T_CAMERA))
    messages.receive("tf2_msgs/msg/TFMessage", "/tf_static", tf, 1.0)
    messages.receive("sensor_msgs/msg/CameraInfo", "/front/camera_info", maker.camera_info(0, CAMERA, FRAME), 1.0)
    yield maker, sink, detector, messages, worker
    detector.go.set()
    worker.close()


def picture(x, y, height=48):
    rgb = np.zeros((height, 64, 3), np.uint8)
    if x is not None:
        rgb[y, x, 0] = 255
    return rgb


def test_the_newest_image_counts_and_the_overtaken_are_counted(robot):
    maker, sink, detector, messages, worker = robot

    def offer(k):
        message = maker.image(k * 10**8, picture(k, 2 * k), "rgb8", FRAME)
        messages.receive(IMAGE, "/front/image", message, 1.0)

    offer(1)
    assert detector.begun.wait(20)
    for k in range(2, 12):
        offer(k)
    detector.go.set()
    while len(sink.detections) < 2:
        assert worker._thread.is_alive()
        time.sleep(0.001)
    worker.close()
    assert [(round(stamp, 3), name) for stamp, name, *_ in sink.detections] == [(0.1, "front"), (1.1, "front")]
    np.testing.assert_array_equal([row[2][0] for row in sink.detections], [[1, 2, 2, 3], [11, 22, 12, 23]])
    assert sink.detections[1][3] == ["spot"]
    assert messages.image("front", 1.1)[22, 11, 2] == 255  # what a view asks for
    assert messages.image("front", 0.7) is None
    assert messages.image("rear", 1.1) is None
    assert messages.ledger.dropped == {"image that a newer one overtook before the detector had time for it": 9}


def test_compressed_images_and_what_is_wrong_with_images(robot):
    maker, sink, detector, messages, worker = robot
    detector.go.set()
    packed = cv2.imencode(".png", picture(5, 6)[:, :, ::-1])[1].tobytes()
    broken = maker.image(10**8, picture(1, 1), "rgb8", FRAME)
    broken.data = broken.data[:10]
    feed = [
        (COMPRESSED, maker.compressed(10**8, packed, "rgb8; png compressed bgr8", FRAME)),
        (COMPRESSED, maker.compressed(2 * 10**8, packed[:40], "png", FRAME)),
        (IMAGE, broken),
        (IMAGE, maker.image(3 * 10**8, np.zeros((48, 64), np.float32), "32FC1", FRAME)),
        (IMAGE, maker.image(4 * 10**8, picture(None, 0), "rgb8", FRAME)),
        (IMAGE, maker.image(5 * 10**8, picture(1, 1, height=24), "rgb8", FRAME)),
    ]
    for number, (type_, message) in enumerate(feed, 1):
        messages.receive(type_, "/front/image", message, 1.0)
        while len(sink.detections) + sum(messages.ledger.dropped.values()) < number:
            assert worker._thread.is_alive()
            time.sleep(0.001)
    ((stamp, _, boxes, *_),) = sink.detections
    assert stamp == pytest.approx(0.1)
    np.testing.assert_array_equal(boxes, [[5, 6, 6, 7]])
    assert messages.ledger.dropped == {
        "image that cannot be decoded": 3,
        "image that the detector failed on": 1,
        "image that has not the size of its camera": 1,
    }
