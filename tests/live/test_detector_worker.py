"""A detector in a thread of its own, with images offered faster than it works."""

import queue
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from robot import BASE_T_CAMERA, Recorder
from waiting import LIMIT, wait_for

sys.path.append(str(Path(__file__).parents[1] / "sources" / "ros"))
from bag_writer import Maker

from objslam.core.camera import Camera
from objslam.detection import Boxes
from objslam.errors import DetectorError
from objslam.live.ros.detector_worker import DetectorWorker
from objslam.live.ros.message_handler import RosMessages

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
        assert self.go.wait(LIMIT)
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
    assert detector.begun.wait(LIMIT)
    for k in range(2, 12):
        offer(k)
    detector.go.set()
    wait_for(lambda: len(sink.detections) == 2 or not worker._thread.is_alive())
    worker.close()
    assert [(round(stamp, 3), name) for stamp, name, *_ in sink.detections] == [(0.1, "front"), (1.1, "front")]
    np.testing.assert_array_equal([row[2][0] for row in sink.detections], [[1, 2, 2, 3], [11, 22, 12, 23]])
    assert sink.detections[1][3] == ["spot"]
    assert messages.image("front", 1.1)[22, 11, 2] == 255  # what a view asks for
    assert messages.image("front", 0.7) is None
    assert messages.image("rear", 1.1) is None
    assert messages.ledger.dropped == {"image replaced by a newer one before the detector was free": 9}


class SlowDetector:
    """A detector that needs a permit for each image, and notes the brightness of the images that it sees."""

    def __init__(self):
        self.permits, self.seen = threading.Semaphore(0), queue.Queue()

    def detect(self, images):
        self.seen.put(int(images[0].max()))
        assert self.permits.acquire(timeout=LIMIT)
        return [Boxes(np.zeros((0, 4)), (), np.zeros(0))]


def test_topics_whose_images_come_faster_than_the_detector_take_turns():
    maker, detector = Maker(), SlowDetector()
    worker = DetectorWorker(detector, lambda: 0.0)
    worker.start(lambda boxes: None, lambda reason, place: None, lambda line: None)
    images = {topic: np.full((48, 64, 3), value, np.uint8) for topic, value in (("/a", 50), ("/b", 100))}
    try:
        for i in range(10):
            for _ in range(3):
                for topic, image in images.items():
                    message = maker.image(i * 10**9, image, "rgb8", FRAME)
                    worker.offer(topic, message, float(i))
            detector.permits.release()
            wait_for(lambda least=i + 2: detector.seen.qsize() >= least)  # One was seen before the first permit.
    finally:
        detector.permits.release(100)
        worker.close()
    counts = np.unique([detector.seen.get() for _ in range(10)], return_counts=True)[1]
    assert len(counts) == 2
    assert counts.min() >= 4


def test_a_detector_that_breaks_on_one_image_goes_on_with_the_next(robot):
    maker, sink, detector, messages, worker = robot
    detector.go.set()
    whole, detector.detect = detector.detect, lambda images: [][0]
    for k in (1, 2):
        messages.receive(IMAGE, "/front/image", maker.image(k * 10**8, picture(k, k), "rgb8", FRAME), 1.0)
        wait_for(lambda k=k: len(sink.detections) + sum(messages.ledger.dropped.values()) >= k)
        assert worker._thread.is_alive()
        detector.detect = whole
    assert [round(stamp, 3) for stamp, *_ in sink.detections] == [0.2]
    assert messages.ledger.dropped == {"image that the detector failed on": 1}
    assert "IndexError" in messages.ledger.examples["image that the detector failed on"][0]


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
        wait_for(lambda number=number: len(sink.detections) + sum(messages.ledger.dropped.values()) >= number)
        assert worker._thread.is_alive()
    ((stamp, _, boxes, *_),) = sink.detections
    assert stamp == pytest.approx(0.1)
    np.testing.assert_array_equal(boxes, [[5, 6, 6, 7]])
    assert messages.ledger.dropped == {
        "image that cannot be decoded": 3,
        "image that the detector failed on": 1,
        "image that does not have the size of its camera": 1,
    }


class Failing:
    """A detector that raises the errors it is given, one an image; None for an image with a box."""

    def __init__(self, *errors):
        self.errors = list(errors)

    def detect(self, images):
        error = self.errors.pop(0)
        if error is not None:
            raise error
        return [Boxes(np.array([[1.0, 1, 9, 9]]), ("spot",), np.array([0.75]))]


class Heard:
    """What a worker hands on, one entry for each image: "boxes", or why there are none and where."""

    def __init__(self, detector, deliver=None):
        self.news, self.warnings, self.maker = queue.Queue(), [], Maker()
        self.worker = DetectorWorker(detector, lambda: 0.0)
        self.worker.start(
            deliver or (lambda boxes: self.news.put("boxes")), lambda *drop: self.news.put(drop), self.warnings.append
        )

    def look(self, k, topic="/front/image"):
        """Offer the image of a stamp, k tenths of a second, and wait for what comes of it."""
        self.worker.offer(topic, self.maker.image(k * 10**8, picture(3, 4), "rgb8", FRAME), k / 10)
        return self.news.get(timeout=LIMIT)


@pytest.fixture
def heard(request):
    one = Heard(*request.param)
    yield one
    one.worker.close()


def cannot(_):
    raise KeyError("front")


@pytest.mark.parametrize(
    "heard", [(Failing(ValueError("bad\nimage"), MemoryError(), None, RuntimeError(""), None),)], indirect=True
)
def test_an_image_that_the_detector_breaks_on_is_counted_and_the_next_one_is_looked_at(heard):
    reason = "image that the detector failed on"
    assert heard.look(1) == (reason, "/front/image at 0.100 s: ValueError: bad")
    assert heard.look(2) == (reason, "/front/image at 0.200 s: MemoryError")
    assert heard.look(3) == "boxes"
    assert heard.look(4) == (reason, "/front/image at 0.400 s: RuntimeError")
    assert heard.look(5) == "boxes"
    assert heard.warnings == []


@pytest.mark.parametrize("heard", [(Failing(None, None), cannot)], indirect=True)
def test_boxes_that_nobody_can_take_are_counted_too(heard):
    for _ in range(2):
        reason, where = heard.look(1)
        assert reason == "image whose boxes could not be handed on"
        assert where == "/front/image at 0.100 s: KeyError: 'front'"


@pytest.mark.parametrize(
    "heard", [(Failing(*[RuntimeError("no device")] * 9, None, *[DetectorError("hot")] * 20),)], indirect=True
)
def test_an_error_at_every_image_of_a_topic_is_said_once(heard):
    for k in range(1, 31):
        heard.look(k)
    (warning,) = heard.warnings
    assert warning == (
        "/front/image: the detector gave no boxes for 5 images in a row, the last at 0.500 s: RuntimeError: no device"
    )


@pytest.mark.parametrize("heard", [(Failing(SystemExit(3)),)], indirect=True)
def test_a_detector_that_ends_its_thread_does_not_do_so_silently(heard):
    assert heard.look(1) == ("image that the detector failed on", "/front/image at 0.100 s: SystemExit: 3")
    heard.worker._thread.join(LIMIT)
    assert heard.look(2) == ("image that arrived after the detector had ended", "/front/image at 0.200 s")
    assert heard.look(3) == ("image that arrived after the detector had ended", "/front/image at 0.300 s")
    assert heard.warnings == ["the detector has ended, later images are dropped: SystemExit: 3"]


def test_a_session_says_what_the_detector_fails_on():
    maker, sink = Maker(), Recorder()
    worker = DetectorWorker(Failing(*[RuntimeError("no device")] * 6), lambda: 0.0)
    messages = RosMessages(sink, detector=worker, clock=lambda: 0.0)
    for number in range(1, 7):
        messages.receive(IMAGE, "/front/image", maker.image(number * 10**8, picture(1, 1), "rgb8", FRAME), 1.0)
        wait_for(lambda number=number: sum(messages.ledger.dropped.values()) >= number)
    worker.close()
    dropped, warned = messages.ledger.lines()
    assert dropped.startswith(
        "dropped 6: image that the detector failed on (first: /front/image at 0.100 s: RuntimeError: no device; "
    )
    assert warned.startswith("/front/image: the detector gave no boxes for 5 images in a row")
