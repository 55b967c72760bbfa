"""Mutated recordings of other projects, models, and messages as they come from a network."""

import shutil
from itertools import chain

import numpy as np
import pytest
from bag_writer import Maker, serialize
from mutations import check, known, mutated, survives
from test_fuzz_messages import intake, rows
from tiny_models import tiny_model

from objslam.config import Detector
from objslam.core.diagnostics import Ledger
from objslam.detection.class_names import names_from_metadata
from objslam.detection.detector import load_detector
from objslam.live.ros.message_handler import RosMessages
from objslam.ros.bag.records import Connection
from objslam.ros.messages.decode import DecodeError, make_decoder
from objslam.sources import SourceOptions, read

MRCLAM = {
    "Barcodes.dat": b"# subject barcode\n1 5\n6 63\n7 25\n",
    "Landmark_Groundtruth.dat": b"6 1.9 -5.0 0.0001 0.0002\n7 0.3 -5.5 0.0002 0.0002\n",
    "Robot1_Groundtruth.dat": b"1000.0 0.5 -2.0 1.5\n1000.5 0.6 -2.0 1.6\n",
    "Robot1_Measurement.dat": b"1000.1 63 3.4 0.1\n1000.1 25 4.0 -0.2\n1000.6 63 3.3 0.1\n",
    "Robot1_Odometry.dat": b"1000.0 0.1 0.0\n1000.2 0.1 0.2\n1000.7 0.0 0.2\n",
}
POSES = b"".join(b"%d.5 %d 0 1 0 0 0 1\n" % (10 + i, i) for i in range(4))
CAMERA = b"""image_width: 64
image_height: 48
camera_matrix: [50, 0, 32, 0, 50, 24, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: []
"""
STAMPED = {
    "groundtruth.txt": POSES,
    "camera.yaml": CAMERA,
    "boxes/11.5.txt": b"41 1 2 3 4 0.5\n",
    "boxes/12.5.txt": b"66 1 2 3 4 0.5\n77 5 6 7 8 0.25\n",
}
NUMBERED = {
    "truth_cam_poses.txt": POSES,
    "camera.yaml": CAMERA,
    "boxes/0000_yolo2_0.15.txt": b"20\t10\t20\t20\t0.9\n",
    "boxes/0001_yolo2_0.15.txt": b"20\t11\t20\t20\t0.9\n",
}
FOLDERS = {"mrclam": MRCLAM, "tum": STAMPED, "tum_numbered": NUMBERED}


@pytest.mark.parametrize("kind", FOLDERS)
def test_mutated_folders(tmp_path, kind):
    """Each file of a recording in turn; the others stay whole."""
    folder = tmp_path / "recording"
    taken = list[bool]()
    for name, good in FOLDERS[kind].items():
        for data in chain([good], known(kind), mutated(good, 20, len(FOLDERS[kind]))):
            shutil.rmtree(folder, ignore_errors=True)
            for other, content in FOLDERS[kind].items():
                (folder / other).parent.mkdir(parents=True, exist_ok=True)
                (folder / other).write_bytes(data if other == name else content)
            options = SourceOptions(format=kind, robot=1)
            taken.append(survives(lambda options=options: read(folder, Ledger(), options), kind, data))
    assert taken[0]


NAMES = [b"{0: 'cup', 1: 'book'}", b'["cup", "book"]', b'{"0": "cup", "1": "book"}', b"('cup',)"]


def test_mutated_names_of_a_model(tmp_path):
    inputs = (data for good in NAMES for data in mutated(good, 100, len(NAMES)))
    for data in chain(NAMES, known("names"), inputs):
        text = data.decode(errors="surrogateescape")
        survives(lambda text=text: names_from_metadata(text, tmp_path), "names", data)


def test_mutated_models(tmp_path):
    """What onnxruntime lets in has sizes and names that objslam can use."""
    file = tmp_path / "model.onnx"
    tiny_model(file, "yolov8", size=(64, 64), metadata={"names": "{0: 'cup', 1: 'book', 2: 'dog'}"}.items())
    good = file.read_bytes()
    at = good.index(b"names")
    spots = (good[: at - 40] + tail for tail in mutated(good[at - 40 :], 25, inputs=2))
    taken = []
    for data in chain([good], known("model"), spots, mutated(good, 15, inputs=2)):
        file.write_bytes(data)
        taken.append(survives(lambda: load_detector(file, Detector(device="cpu")), "model", data))
    assert taken[0]


def test_mutated_network_messages():
    """The bytes of one message after another, as a publisher may send them, through decoder and handler to the session."""
    maker, taken = Maker(), []
    messages = RosMessages(intake(taken), clock=lambda: 1.0)
    good = [(topic, message.__msgtype__, serialize(maker, message)) for topic, _, message in rows()]
    for topic, type_, content in good:
        decode = make_decoder(Connection(topic, type_, "cdr"))
        for data in chain([content], known("cdr"), mutated(content, 10, len(good))):

            def push(decode=decode, data=data, type_=type_, topic=topic):
                try:
                    message = decode(data)
                except DecodeError:
                    return
                messages.receive(type_, topic, message, 1.0)

            survives(push, "cdr", data)
    assert taken
    for message in taken[-1000:]:
        check(message)
    assert all(np.isfinite(getattr(message, "stamp", 0.0)) for message in taken)
