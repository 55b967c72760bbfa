"""Two real detectors, of different makers and layouts, on two photographs whose content is plain to see."""

import cv2
import numpy as np
import pytest

from objslam.config import Detector as Settings
from objslam.config import Settings as AllSettings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.detection import detect_log, load_detector

CONTENT = {"dog.jpg": {"dog", "bicycle", "car"}, "person.jpg": {"person", "dog", "horse"}}
LAYOUTS = {"yolov12n.onnx": "yolov8", "yolox_nano_416.onnx": "yolox"}


@pytest.fixture(scope="module")
def onnx_dir(data_dir):
    folder = data_dir / "onnx"
    if not folder.is_dir():
        pytest.skip(f"no ONNX models at {folder}")
    return folder


@pytest.fixture(scope="module")
def detectors(onnx_dir):
    return {name: load_detector(onnx_dir / name, Settings(threads=1, min_score=0.4)) for name in LAYOUTS}


@pytest.fixture(scope="module")
def found(detectors, onnx_dir):
    images = {photo: cv2.imread(str(onnx_dir / photo)) for photo in CONTENT}
    return {(name, photo): d.detect([image])[0] for name, d in detectors.items() for photo, image in images.items()}


def iou(a, b):
    inside = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None).prod()
    return inside / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - inside)


def test_the_layouts_are_recognised(detectors):
    assert {name: d.recipe.layout for name, d in detectors.items()} == LAYOUTS
    assert [len(d.recipe.names) for d in detectors.values()] == [80, 80]
    assert detectors["yolov12n.onnx"].warnings == ()
    assert "coco" in detectors["yolox_nano_416.onnx"].warnings[0]


@pytest.mark.parametrize("photo", CONTENT)
def test_both_find_what_is_there_in_the_same_place(found, photo):
    first, second = (found[name, photo] for name in LAYOUTS)
    for boxes in (first, second):
        assert set(boxes.labels) == CONTENT[photo]
        assert len(boxes.labels) == len(CONTENT[photo])
    for label in CONTENT[photo]:
        overlap = iou(first.boxes[first.labels.index(label)], second.boxes[second.labels.index(label)])
        assert overlap >= 0.5, label


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_smaller_photograph_has_its_boxes_in_the_same_places(detectors, found, onnx_dir, name):
    for photo in CONTENT:
        image = cv2.imread(str(onnx_dir / photo))
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        (small,) = detectors[name].detect([half])
        whole = found[name, photo]
        for label in CONTENT[photo]:
            assert iou(small.boxes[small.labels.index(label)] * 2, whole.boxes[whole.labels.index(label)]) > 0.8


def test_a_log_of_the_photographs(detectors, onnx_dir, tmp_path):
    stamps = np.array([1.0, 2.0])
    path = Trajectory(stamps, np.tile(np.eye(4), (2, 1, 1)))
    height, width = cv2.imread(str(onnx_dir / "dog.jpg")).shape[:2]
    images = Images(stamps, tuple(onnx_dir / photo for photo in CONTENT))
    log = Log("photographs", (CameraLog(Camera("camera", width, height, np.eye(3)), rgb=images),), localization=path)
    ledger = Ledger()
    log = detect_log(log, detectors["yolox_nano_416.onnx"], AllSettings(), ledger, cache=tmp_path)
    detections = log.cameras[0].detections
    assert detections.frame_stamps.tolist() == [1.0]  # person.jpg has another size
    assert {detections.label_names[i] for i in detections.label} == CONTENT["dog.jpg"]
    assert ledger.dropped == {"rgb image that does not have the camera's size": 1}
