"""Every layout with a tiny model that finds rectangles: boxes, classes and scores come back through all that is between."""

import numpy as np
import pytest
from onnx import TensorProto
from tiny_models import COLOURS, IMAGENET, SCORE, scene, tiny_model

from objslam.config import Detector as Settings
from objslam.detection import load_detector
from objslam.detection.onnx_model import Network

ONE = [[100, 60, 260, 200], [300, 250, 420, 430], [500, 40, 560, 130]]
TWO = [[40, 300, 180, 440], [330, 20, 530, 160], [400, 200, 600, 400]]
YOLOX = {"size": (416, 416), "colour": "bgr", "divide_by": 1.0}
RTDETR = {"description": "Ultralytics rtdetr-l model", "names": list(COLOURS)}
FAMILIES = {
    "ssd": ("ssd", {}),
    "ssd_fractions": ("ssd", {}),
    "dets": ("ssd", {}),
    "yolov8": ("yolov8", {}),
    "yolov8_segment": ("yolov8", {}),
    "yolov5": ("yolov5", {}),
    "end_to_end": ("end_to_end", {}),
    "yolox": ("yolox", YOLOX),
    "yolox_decoded": ("yolox_decoded", YOLOX),
    "detr": ("detr", {}),
    "detr_softmax": ("detr", {"normalise": IMAGENET}),
    "rtdetr_ultralytics": ("detr", {"metadata": RTDETR}),
    "rtdetr_best": ("end_to_end", {"metadata": RTDETR | {"head": "RTDETRDecoder"}}),
}


def build(path, family, **options):
    layout, own = FAMILIES[family]
    options = {"metadata": {"names": str(dict(enumerate(COLOURS)))}, **own, **options}
    return layout, tiny_model(path / f"{family}.onnx", family, **options)


def check(found, truth, score=SCORE, tolerance=0.5):
    assert sorted(found.labels) == sorted(COLOURS)
    order = [found.labels.index(name) for name in COLOURS]
    np.testing.assert_allclose(found.boxes[order], truth, atol=tolerance)
    np.testing.assert_allclose(found.scores, score, atol=0.01)


@pytest.mark.parametrize("batch", [1, None])
@pytest.mark.parametrize("family", FAMILIES)
def test_boxes_come_back_to_half_a_pixel(tmp_path, family, batch):
    layout, model = build(tmp_path, family, batch=batch)
    first = Settings(first_label=1) if family == "ssd_fractions" else Settings()
    detector = load_detector(model, first.model_copy(update={"batch": 2}))
    assert detector.recipe.layout == layout
    assert detector.batch == (1 if batch else 2)
    assert detector.warnings == ()
    found = detector.detect([scene(ONE), scene(TWO), scene(ONE)])
    for boxes, truth in zip(found, (ONE, TWO, ONE), strict=True):
        check(boxes, truth)


@pytest.mark.parametrize("size", [(640, 480), (832, 468), (320, 240), (500, 375), (480, 640), (641, 479)])
@pytest.mark.parametrize("family", ["yolov8", "yolox", "ssd"])
def test_images_of_any_size(tmp_path, family, size):
    _, model = build(tmp_path, family)
    truth = np.rint(np.array(ONE) * np.tile(np.divide(size, (640, 480)), 2)).astype(int)
    (found,) = load_detector(model, Settings()).detect([scene(truth, *size)])
    check(found, truth)


def test_images_of_different_sizes_together(tmp_path):
    _, model = build(tmp_path, "yolov8", batch=None)
    half = np.array(ONE) // 2
    found = load_detector(model, Settings(batch=4)).detect([scene(ONE), scene(TWO), scene(half, 320, 240), scene(ONE)])
    for boxes, truth in zip(found, (ONE, TWO, half, ONE), strict=True):
        check(boxes, truth)
    assert load_detector(model, Settings()).detect([]) == []


@pytest.mark.parametrize("family", ["yolov8", "yolox", "detr", "ssd"])
def test_a_fixed_batch_is_filled_up(tmp_path, family):
    _, model = build(tmp_path, family, batch=2)
    detector = load_detector(model, Settings())
    assert detector.batch == 2
    for boxes, truth in zip(detector.detect([scene(ONE), scene(TWO), scene(TWO)]), (ONE, TWO, TWO), strict=True):
        check(boxes, truth)


def input_shapes(monkeypatch):
    shapes, run = [], Network.run
    monkeypatch.setattr(Network, "run", lambda network, blob: shapes.append(blob.shape) or run(network, blob))
    return shapes


@pytest.mark.parametrize(
    ("options", "shape"),
    [
        ({}, (1, 3, 480, 640)),
        ({"size": (320, 320)}, (1, 3, 256, 320)),
        ({"size": (500, 500)}, (1, 3, 384, 512)),
        ({"resize": "none"}, (1, 3, 480, 640)),
        ({"resize": "stretch", "size": (320, 640)}, (1, 3, 640, 320)),
    ],
)
def test_a_dynamic_input_shrinks_to_the_image(tmp_path, monkeypatch, options, shape):
    _, model = build(tmp_path, "yolov8", size=(None, None))
    shapes = input_shapes(monkeypatch)
    detector = load_detector(model, Settings(layout="yolov8", **options))
    (found,) = detector.detect([scene(ONE)])
    assert shapes[-1] == shape
    check(found, ONE)


def test_a_dynamic_input_takes_the_size_of_the_training(tmp_path, monkeypatch):
    metadata = {"names": list(COLOURS), "imgsz": "[320, 320]", "stride": "64"}
    _, model = build(tmp_path, "yolov8", size=(None, None), metadata=metadata)
    shapes = input_shapes(monkeypatch)
    load_detector(model, Settings(layout="yolov8")).detect([scene(ONE)])
    assert shapes == [(1, 3, 320, 320), (1, 3, 256, 320)]


def test_half_precision(tmp_path):
    _, model = build(tmp_path, "yolov8", kind=TensorProto.FLOAT16)
    check(load_detector(model, Settings()).detect([scene(ONE)])[0], ONE)


def test_torchvision_takes_one_image_without_a_batch_and_counts_from_1(tmp_path):
    model = tiny_model(tmp_path / "torchvision.onnx", "ssd", size=(None, None), rank=3)
    background = load_detector(model, Settings(names=("__background__", "red", "green")))
    assert background.detect([scene(ONE)])[0].labels == ("red", "green")
    detector = load_detector(model, Settings(names=("red", "green", "blue"), first_label=0, batch=4))
    assert detector.batch == 1
    for boxes, truth in zip(detector.detect([scene(ONE), scene(TWO)]), (ONE, TWO), strict=True):
        check(boxes, truth, tolerance=1e-3)
    assert load_detector(model, Settings(names=("red", "green", "blue"))).recipe.first_label == 1


def test_tensorflow_takes_bytes_with_the_channels_last(tmp_path):
    model = tiny_model(
        tmp_path / "tf.onnx",
        "tensorflow",
        size=(None, None),
        kind=TensorProto.UINT8,
        channels_last=True,
        divide_by=1.0,
        metadata={"names": list(COLOURS)},
    )
    (found,) = load_detector(model, Settings()).detect([scene(ONE)])
    check(found, ONE, tolerance=1e-2)


def test_yolov7_end_to_end_has_one_row_a_box(tmp_path):
    model = tiny_model(tmp_path / "yolov7.onnx", "yolov7", metadata={"names": list(COLOURS)})
    detector = load_detector(model, Settings())
    assert detector.recipe.layout == "end_to_end"
    check(detector.detect([scene(TWO)])[0], TWO)


def test_what_the_detr_family_asks_for_besides_the_image_is_fed(tmp_path):
    extra = [("pixel_mask", TensorProto.INT64, ["batch", 64, 64]), ("orig_target_sizes", TensorProto.INT64, ["batch", 2])]
    _, model = build(tmp_path, "detr", batch=None, extra=extra)
    check(load_detector(model, Settings()).detect([scene(ONE)])[0], ONE)


def test_an_empty_image_has_no_boxes(tmp_path):
    for family in FAMILIES:
        _, model = build(tmp_path, family)
        (found,) = load_detector(model, Settings(first_label=0)).detect([scene([])])
        assert (found.boxes.shape, found.labels, found.scores.shape) == ((0, 4), (), (0,)), family


def test_a_box_beyond_the_edge_ends_there(tmp_path):
    _, model = build(tmp_path, "yolov8")
    truth = [[0, 0, 100, 100], [500, 380, 640, 480], [200, 100, 300, 200]]
    (found,) = load_detector(model, Settings()).detect([scene(truth)])
    check(found, truth)
    assert (found.boxes >= 0).all()
    assert (found.boxes <= [640, 480, 640, 480]).all()


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3))])
def test_only_colour_images_of_bytes_are_taken(tmp_path, image):
    _, model = build(tmp_path, "ssd")
    with pytest.raises(ValueError, match="must be"):
        load_detector(model, Settings()).detect([image])
