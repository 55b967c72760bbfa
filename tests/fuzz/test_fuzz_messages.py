"""Mutated ROS bags, messages of a running robot and JSON lines."""

import io
import json
from functools import partial
from itertools import chain

import cv2
import numpy as np
import pytest
from bag_writer import Maker, Raw, serialize, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import altered, check, examples, mutated, survives

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.live.adapters.stdin import StdinAdapter
from objslam.live.counters import Counters
from objslam.live.ros.message_handler import RosMessages
from objslam.live.session.intake import Intake
from objslam.ros.bag.records import Connection
from objslam.ros.messages.decode import DecodeError, make_decoder
from objslam.simulation import make_camera
from objslam.sources.journal.records import decode, encode
from objslam.sources.ros_bag.info import describe
from objslam.sources.ros_bag.log import read_bag

S = 10**9
FRAME = "camera_optical_frame"
MAKER = Maker()


def rows():
    """A second of a drive: a message of each type that objslam reads, twice."""
    picture = np.zeros((4, 6, 3), dtype=np.uint8)
    png = cv2.imencode(".png", picture)[1].tobytes()
    depth = cv2.imencode(".png", np.full((4, 6), 1000, dtype=np.uint16))[1].tobytes()
    made = []
    for t in (S, 2 * S):
        made += [
            ("/odom", t, MAKER.odometry(t, np.eye(4))),
            ("/pose", t, MAKER.pose_stamped(t, np.eye(4))),
            ("/tf", t, MAKER.tf(t, ("map", "odom", np.eye(4)))),
            ("/tf_static", t, MAKER.tf(t, ("base_link", FRAME, np.eye(4)))),
            ("/camera_info", t, MAKER.camera_info(t, make_camera("front"), FRAME)),
            ("/boxes", t, MAKER.detections(t, [(1, 2, 30, 40, "cup", 0.9, "7")])),
            ("/tags", t, MAKER.tags(t, [(3, np.array([[0, 0], [9, 0], [9, 9], [0, 9]]))])),
            ("/image", t, MAKER.image(t, picture, "bgr8", FRAME)),
            ("/image/compressed", t, MAKER.compressed(t, png, "png", FRAME)),
            ("/depth/compressedDepth", t, MAKER.compressed(t, bytes(12) + depth, "32FC1; compressedDepth", FRAME)),
        ]
    return made


@pytest.mark.parametrize("kind", ["mcap-none", "sqlite3", "bag"])
def test_mutated_bags(tmp_path, kind):
    maker = Maker("1") if kind == "bag" else MAKER
    made = [("/odom", S, maker.odometry(S, np.eye(4)))] if kind == "bag" else rows()
    found = write_bag(tmp_path / "drive", kind, maker, made)
    file = next(found.glob("*.db3")) if found.is_dir() else found
    for data in mutated(file.read_bytes(), 12, inputs=2):
        file.write_bytes(data)
        survives(lambda: describe(found))
        survives(lambda: read_bag(found, Ledger()))


@settings(max_examples=examples(40, inputs=2))
@given(data=st.data())
def test_mutated_messages_in_a_whole_bag(tmp_path_factory, data):
    made = rows()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(made) - 1))
        topic, time, message = made[at]
        made[at] = topic, time, Raw(_damaged(data, serialize(MAKER, message)), message.__msgtype__)
    file = write_bag(tmp_path_factory.getbasetemp() / "altered", "mcap-none", MAKER, made)
    survives(lambda: describe(file))
    survives(lambda: read_bag(file, Ledger()))


def _damaged(data, content):
    at = data.draw(st.integers(4, len(content)))
    return content[:at] + data.draw(st.binary(max_size=8)) + content[at + data.draw(st.sampled_from([0, 1, 4, 8, 8, 8])) :]


def intake(taken):
    def deliver(message, arrival):
        taken.append(message)
        return True

    return Intake(load_settings(None, ("mode=joint",)), Counters(), deliver)


def checked(taken):
    """What an intake delivers is valid, and the journal reads it back."""
    for message in taken:
        check(message)
        decode(encode(message))


@settings(max_examples=examples(100, inputs=20))
@given(data=st.data())
def test_mutated_messages_of_a_robot(data):
    taken = []
    messages = RosMessages(intake(taken), clock=lambda: 1.0)
    for topic, time, message in rows():
        content, type_ = serialize(MAKER, message), message.__msgtype__
        if data.draw(st.booleans()):
            content = _damaged(data, content)
        assert survives(partial(receive, messages, type_, topic, content, time / S))
    checked(taken)


def receive(messages, type_, topic, content, time):
    """Take the bytes of a message, as a live adapter does."""
    try:
        decoded = make_decoder(Connection(topic, type_, "cdr"))(content)
    except DecodeError:
        return
    messages.receive(type_, topic, decoded, time)


CAMERA = {
    "type": "camera",
    "name": "front",
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": [500, 0, 320, 0, 500, 240, 0, 0, 1],
    "distortion_model": "plumb_bob",
    "distortion_coefficients": [0, 0, 0, 0, 0],
    "base_T_camera": {"translation": [0, 0, 0], "rotation_xyzw": [0, 0, 0, 1]},
}
POSE = {"stamp": 1.0, "translation": [0, 0, 0], "rotation_xyzw": [0, 0, 0, 1]}
BOXES = {"boxes": [[1, 2, 3, 4]], "labels": ["cup"], "scores": [0.9], "depths": [1.0], "track_ids": [3]}
LINES = [
    CAMERA,
    {"type": "odometry", **POSE, "covariance": np.eye(6).ravel().tolist()},
    {"type": "localization", "stamp": 1.0, "x": 1.0, "y": 2.0, "yaw": 0.3},
    {"type": "mount", "camera": "front", **POSE},
    {"type": "detections", "camera": "front", "stamp": 1.0, **BOXES},
]


@settings(max_examples=examples(200, inputs=len(LINES)))
@given(data=st.data())
def test_altered_json_lines(data):
    taken = []
    adapter = StdinAdapter(intake(taken), io.BytesIO())
    for number, line in enumerate(LINES):
        adapter._take(json.dumps(line).encode(), number)
        assert survives(partial(adapter._take, json.dumps(data.draw(altered(line))).encode(), number))
    assert len(taken) >= 1
    checked(taken)


def test_mutated_json_lines():
    taken = []
    adapter = StdinAdapter(intake(taken), io.BytesIO())
    for number, data in enumerate(chain.from_iterable(mutated(json.dumps(line).encode(), 60, len(LINES)) for line in LINES)):
        survives(lambda data=data, number=number: adapter._take(data, number), "lines", data)
    assert taken
    checked(taken)
