"""Mutated files of a log: trajectories, cameras, calibrations, detections, image lists, journals, settings and images."""

import json
from dataclasses import replace
from functools import partial
from itertools import chain

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import altered, as_json, examples, known, mutated, survives

from objslam.config import Settings, dump_settings, load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.io.calibration_yaml import dump_calibration, load_calibration
from objslam.io.camera_yaml import read_calibrations, write_camera
from objslam.io.detections_jsonl import read_detections
from objslam.io.image_list import read_images
from objslam.io.images import decode_colour, decode_depth
from objslam.io.objects_json import read_objects, read_truth_objects
from objslam.io.tum_trajectory import read_trajectory
from objslam.simulation import make_camera
from objslam.sources.journal.corrections import AssociationMessage, BodiesMessage, CalibrationMessage, NamesMessage
from objslam.sources.journal.journal import Journal
from objslam.sources.journal.log import read_journal
from objslam.sources.journal.reader import messages
from objslam.sources.journal.records import (
    CameraMessage,
    FrameMessage,
    MountMessage,
    NoteMessage,
    PoseMessage,
    decode,
    encode,
)

TUM = b"# stamp tx ty tz qx qy qz qw\n1.0 0 0 0 0 0 0 1\n1.5 0.1 0 0 0 0 0.1 0.995\n2.0 0.2 0 0 0 0 0.2 0.98\n"
LIST = b"# stamp path\n1.0 rgb/1.png\n2.0 rgb/2.png\n"
FRAME = {"stamp": 12.5, "boxes": [[1, 2, 3, 4]], "labels": ["cup"], "scores": [0.9], "depths": [1.2], "track_ids": [3]}
OBJECT = {
    "id": 0, "label": "cup", "position": [1, 2.0, 3], "covariance": np.eye(3).tolist(), "status": "ok",
    "rays": 3, "frames": 3,
    "parallax_deg": 9.0, "rms_deg": 0.1, "extent": [0.1, 0.2], "first_seen": 0.0, "last_seen": 1.0, "labels": {"cup": 1.0},
    "existence": 0.9, "ray": {"origin": [0, 0, 0], "direction": [1, 0, 0]},
}  # fmt: skip
OBJECTS = {"format": "objslam.objects/1", "frame": "map", "objects": [OBJECT, OBJECT | {"id": 1, "status": "unresolved"}]}
CALIBRATION = Calibration(("odometry.scale", "front.clock"), np.array([0.1, 0.0]), np.eye(2), np.ones(2))
FRAMES = FrameMessage(2.0, "front", np.array([[1.0, 1, 9, 9]]), ("cup",), np.ones(1), np.ones(1), np.array([3]))
MESSAGES = [
    CameraMessage(make_camera("front", yaw=0.2)),
    PoseMessage("odometry", 1.0, np.eye(4)),
    MountMessage(1.0, "front", np.eye(4)),
    NoteMessage(0.5, np.eye(4)),
    FRAMES,
    replace(FRAMES, whole=True, stamp=3.0),
    CalibrationMessage(3, CALIBRATION),
    BodiesMessage(3, np.array([4]), np.array([2]), np.ones((1, 3)), np.zeros(1), np.eye(4)[None]),
    AssociationMessage(
        3, (np.array([1, 5]), np.array([4])), np.ones((2, 3)), np.array([7]), np.arange(2), np.array([np.eye(4)] * 2)
    ),
    NamesMessage(3, np.array([0, 2]), np.array([1]), np.array([4, 3])),
]


def camera_text(folder):
    write_camera(make_camera("front", yaw=0.2), folder / "corpus.yaml")
    return (folder / "corpus.yaml").read_bytes()


FILES = {
    "trajectory": (lambda folder: TUM, "odometry.txt", lambda file: read_trajectory(file, Ledger()), 400),
    "image list": (lambda folder: LIST, "rgb.txt", lambda file: read_images(file, Ledger()), 100),
    "detections": (
        lambda folder: as_json(FRAME) + b"\n",
        "detections.jsonl",
        lambda file: read_detections(file, Ledger()),
        300,
    ),
    "camera": (camera_text, "camera.yaml", lambda file: read_calibrations(file, Ledger()), 150),
    "calibration": (
        lambda folder: dump_calibration(CALIBRATION).encode(),
        "calibration.yaml",
        load_calibration,
        100,
    ),
    "objects": (lambda folder: as_json(OBJECTS), "objects.json", read_objects, 400),
    "truth": (lambda folder: as_json(OBJECTS), "truth.json", read_truth_objects, 100),
    "settings": (lambda folder: dump_settings(Settings()).encode()[:900], "config.yaml", load_settings, 60),
}
"""The targets by name: the corpus, the name of the file, the reader and the number of inputs."""


@pytest.mark.parametrize("name", FILES)
def test_mutated_bytes(tmp_path, name):
    corpus, called, read, count = FILES[name]
    file = tmp_path / called
    good = corpus(tmp_path)
    taken = []
    for data in mutated(good, count):
        file.write_bytes(data)
        taken.append(survives(lambda: read(file)))
    if name not in ("settings", "image list"):
        assert any(taken)
    assert not all(taken)


STRUCTURED = {
    "detections": (FRAME, lambda file: read_detections(file, Ledger())),
    "objects": (OBJECTS, read_objects),
    "truth": (OBJECTS, read_truth_objects),
    "camera": (None, lambda file: read_calibrations(file, Ledger())),
    "calibration": (CALIBRATION.to_dict(), load_calibration),
    "settings": (Settings().model_dump(mode="json"), load_settings),
}


@pytest.mark.parametrize("name", STRUCTURED)
@settings(max_examples=examples(60))
@given(data=st.data())
def test_altered_structures(tmp_path_factory, name, data):
    folder = tmp_path_factory.getbasetemp()
    corpus, read = STRUCTURED[name]
    corpus = yaml.safe_load(camera_text(folder)) if corpus is None else corpus
    file = folder / "altered.txt"
    file.write_bytes(as_json(data.draw(altered(corpus))))
    survives(lambda: read(file))


@settings(max_examples=examples(300))
@given(data=st.data())
def test_altered_journal_records(data):
    record = encode(data.draw(st.sampled_from(MESSAGES)))
    if record[:1] in b"CFNS":
        record = record[:1] + as_json(data.draw(altered(json.loads(record[1:]))))
    else:
        at = data.draw(st.integers(0, len(record) - 1))
        record = record[:at] + data.draw(st.binary(min_size=1, max_size=8)) + record[at + 8 :]
    if survives(lambda: decode(record)):
        assert decode(encode(decode(record)))  # what was let in can be written again


def test_mutated_journals(tmp_path):
    file = tmp_path / "journal.objslam"
    journal = Journal(file)
    for message in MESSAGES:
        journal.write(message)
    journal.close()
    for data in mutated(file.read_bytes(), 200, inputs=2):
        file.write_bytes(data)
        survives(lambda: list(messages(file, Ledger())))
        survives(lambda: read_journal(file, Ledger()))


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tiff", ".webp", ".bmp", ".gif", ".ppm", ".pam"])
def test_mutated_images(ending):
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    good = cv2.imencode(ending, picture)[1].tobytes()
    for data in chain([good], known("image"), mutated(good, 60, inputs=2)):
        for decode_image in (decode_colour, decode_depth):
            assert survives(partial(read_image, decode_image, data), "image", data)


def read_image(decode_image, data):
    image = decode_image(data)
    assert image is None or image.size > 0
