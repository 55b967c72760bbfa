"""What is told from a model, what the settings change of it, and what a user reads when something does not fit."""

import json
import re
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import yaml
from onnx import TensorProto
from tiny_models import COLOURS, SCORE, scene, tiny_model

from objslam.config import Detector as Settings
from objslam.config import dump_settings, load_settings
from objslam.core.coco import COCO_NAMES
from objslam.detection import load_detector
from objslam.detection.class_names import KNOWN, names_from_metadata
from objslam.detection.output_layouts import Facts, Output, recognise
from objslam.errors import ConfigError, DetectorError

ONE = [[100, 60, 260, 200], [300, 250, 420, 430], [500, 40, 560, 130]]
CONFIGS = Path(__file__).parents[2] / "configs"


def load(path, family="yolov8", metadata=None, **settings):
    model = tiny_model(path / "model.onnx", family, metadata={"names": list(COLOURS)} if metadata is None else metadata)
    return load_detector(model, Settings(**settings))


def labels(detector):
    return set(detector.detect([scene(ONE)])[0].labels)


def refused(path, error, *args, **kwargs):
    with pytest.raises(error) as caught:
        labels(load(path, *args, **kwargs))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("shape", "facts", "layout"),
    [
        ((1, 84, 8400), {}, "yolov8"),
        ((1, 84, 6300), {"height": 480}, "yolov8"),
        ((1, 5, 8400), {"classes": 1}, "yolov8"),
        ((1, 8400, 84), {"classes": 80}, "yolov8"),
        ((1, 84, 34000), {}, "yolov8"),
        ((1, 14, 500), {"classes": 10}, "yolov8"),
        ((1, 25200, 85), {}, "yolov5"),
        ((1, 25200, 6), {}, "yolov5"),
        ((1, 25500, 85), {}, "yolov5"),
        ((1, 900, 15), {"classes": 10}, "yolov5"),
        ((1, 8400, 85), {}, "yolox"),
        ((1, 3549, 6), {"height": 416, "width": 416}, "yolox"),
        ((1, 300, 6), {}, "end_to_end"),
        ((1, 0, 6), {}, "end_to_end"),
        ((1, 300, 38), {"metadata": {"end2end": "True"}}, "end_to_end"),
        ((5, 7), {}, "end_to_end"),
        ((1, 300, 84), {"classes": 80}, "detr"),
        ((1, 300, 6), {"classes": 2, "metadata": {"description": "Ultralytics RT-DETR-l model"}}, "detr"),
        ((1, 300, 6), {"metadata": {"description": "Ultralytics rtdetr-l model", "head": "RTDETRDecoder"}}, "end_to_end"),
    ],
)
def test_one_output_is_told_by_its_shape(shape, facts, layout):
    facts = Facts(**({"height": 640, "width": 640, "classes": None, "metadata": {}} | facts))
    extra = [
        Output("masks", np.zeros((1, 32, 160, 160), np.float32)),
        Output("raw", np.zeros((1, 3, 80, 80, 85), np.float32)),
    ]
    outputs = [Output("output0", np.zeros(shape, np.float32)), *extra]
    assert recognise(outputs, Settings(), facts, Path("m.onnx")) == (layout, {"predictions": "output0"})


@pytest.mark.parametrize(
    ("boxes", "others", "roles"),
    [
        ((7, 4), {"a": ((7,), "i8"), "b": ((7,), "f4")}, {"boxes": "boxes", "labels": "a", "scores": "b"}),
        ((1, 9, 4), {"s": ((1, 9), "f4"), "l": ((1, 9), "i4")}, {"boxes": "boxes", "labels": "l", "scores": "s"}),
        ((1, 9, 4), {"class": ((1, 9, 1), "f4"), "x": ((1, 9), "f4")}, {"boxes": "boxes", "labels": "class", "scores": "x"}),
        ((0, 4), {"a": ((0,), "i8"), "b": ((0,), "f4")}, {"boxes": "boxes", "labels": "a", "scores": "b"}),
        ((1, 9, 5), {"labels": ((1, 9), "i8")}, {"boxes": "boxes", "labels": "labels"}),
        ((1, 300, 4), {"x": ((1, 300, 80), "f4")}, {"boxes": "boxes", "logits": "x"}),
        ((1, 300, 4), {"labels": ((1, 300, 4), "f4")}, {"boxes": "boxes", "logits": "labels"}),
    ],
)  # fmt: skip
def test_several_outputs_are_told_by_shape_kind_and_name(boxes, others, roles):
    outputs = [Output(name, np.zeros(shape, kind)) for name, (shape, kind) in others.items()]
    outputs.insert(1, Output("boxes", np.zeros(boxes, np.float32)))
    found = recognise(outputs, Settings(), Facts(640, 640, None, {}), Path("m.onnx"))
    assert found == ("detr" if "logits" in roles else "ssd", roles)


def test_an_unknown_layout_says_what_it_saw_and_how_to_describe_it(tmp_path):
    text = refused(tmp_path, DetectorError, "unknown")
    assert "heat [1, 3, 2, 2] float32; offset [1, 3] float32" in text
    assert "detector.layout" in text
    assert "detector.outputs" in text
    assert "yolov8" in text
    assert "not the layout yolov5" in refused(tmp_path, DetectorError, "unknown", layout="yolov5")
    # boxes and class scores on a grid: the description that the hint asks for is enough
    grid = [Output("b", np.zeros((1, 8400, 4), np.float32)), Output("s", np.zeros((1, 8400, 80), np.float32))]
    facts = Facts(640, 640, None, {})
    with pytest.raises(DetectorError, match=r"b \[1, 8400, 4\] float32; s \[1, 8400, 80\]"):
        recognise(grid, Settings(), facts, Path("m.onnx"))
    described = Settings(outputs={"boxes": "b", "logits": "s"})
    assert recognise(grid, described, facts, Path("m.onnx")) == ("detr", {"boxes": "b", "logits": "s"})


def test_outputs_can_be_named(tmp_path):
    model = tiny_model(
        tmp_path / "m.onnx",
        "ssd_fractions",
        names={"boxes": "a", "classes": "b", "scores": "c"},
        metadata={"names": list(COLOURS)},
    )
    with pytest.raises(DetectorError, match="fit no layout") as failed:
        load_detector(model, Settings())
    assert "--names" not in str(failed.value)  # It has names.
    with pytest.raises(DetectorError, match="name its classes with --names FILE"):
        load_detector(
            tiny_model(tmp_path / "n.onnx", "ssd_fractions", names={"boxes": "a", "classes": "b", "scores": "c"}), Settings()
        )
    roles = {"boxes": "a", "labels": "b", "scores": "c"}
    detector = load_detector(model, Settings(outputs=roles, first_label=1))
    assert labels(detector) == set(COLOURS)
    with pytest.raises(ConfigError, match=r"no output 'd' \(it has a \[1, 3, 4\] float32; b"):
        load_detector(model, Settings(outputs=roles | {"scores": "d"}))
    with pytest.raises(ConfigError, match="names boxes, scores, but the layout ssd has"):
        load_detector(model, Settings(outputs={"boxes": "a", "scores": "c"}))


def test_settings_go_before_what_is_told(tmp_path):
    described = {"layout": "yolov8", "colour": "bgr", "names": ["blue", "green", "red"], "mean": [0.1, 0.1, 0.1]}
    metadata = {"names": ["x", "y", "z"], "objslam.detector": described}
    detector = load(tmp_path, metadata=metadata)
    assert (detector.recipe.colour, detector.recipe.mean) == ("bgr", (0.1, 0.1, 0.1))
    assert labels(detector) == set(COLOURS)
    detector = load(tmp_path, metadata=metadata, colour="rgb", mean=(0, 0, 0), names=COLOURS)
    (found,) = detector.detect([scene(ONE)])
    assert [found.labels.index(c) for c in COLOURS] == np.argsort(
        [[100, 300, 500].index(x) for x in np.rint(found.boxes[:, 0])]
    ).tolist()
    np.testing.assert_allclose(found.scores, SCORE, atol=1e-3)


@pytest.mark.parametrize("wrong", ["{", '{"layout": "yolo"}', '{"speed": 1}', '{"min_score": 0.1}', "[1]"])
def test_a_models_own_description_may_be_wrong(tmp_path, wrong):
    assert "objslam.detector in the model's metadata is wrong" in refused(
        tmp_path, DetectorError, metadata={"objslam.detector": wrong}
    )


@pytest.mark.parametrize(
    ("changed", "score"),
    [
        ({"divide_by": 510.0}, 0.45),
        ({"std": (2.0, 2.0, 2.0)}, 0.45),
        ({"mean": (0.2, 0.2, 0.2)}, SCORE),
        ({"colour": "bgr"}, SCORE),
    ],
)
def test_values_go_in_as_set(tmp_path, changed, score):
    (found,) = load(tmp_path, **changed).detect([scene(ONE)])
    np.testing.assert_allclose(found.scores, score, atol=1e-3)
    left = found.labels[int(np.argmin(found.boxes[:, 0]))]
    assert left == ("blue" if "colour" in changed else "red")


def test_scores_overlaps_and_numbers_of_boxes_have_limits(tmp_path):
    def count(**settings):
        return len(load(tmp_path, **settings).detect([scene(ONE)])[0].scores)

    assert count() == 3
    assert count(nms=False) == 6
    assert count(iou=1.0) == 6
    assert count(nms=False, min_score=0.8) == 3  # the doubles have 0.72
    assert count(min_score=0.95) == 0
    assert count(nms=False, max_boxes=2) == 2


def test_only_the_classes_that_are_wanted(tmp_path):
    assert labels(load(tmp_path, classes=("blue", "red"))) == {"blue", "red"}
    text = refused(tmp_path, ConfigError, classes=("bleu",))
    assert "no class 'bleu'" in text
    assert "blue" in text


class TestNames:
    def test_dictionaries_and_lists_of_python_and_json(self):
        for text in (
            "{0: 'a', 1: 'b'}",
            '{"0": "a", "1": "b"}',
            "['a', 'b']",
            '["a", "b"]',
            "('a', 'b')",
            "{1: 'b', 0: 'a'}",
        ):
            assert names_from_metadata(text, Path("m")) == ("a", "b")
        assert names_from_metadata("{1: 'b'}", Path("m")) == ("class_0", "b")
        assert names_from_metadata(None, Path("m")) is None

    @pytest.mark.parametrize(
        "text", ["nothing", "{", "[[1]]", "{'a': 'b'}", "[]", "{-1: 'a'}", "__import__('os').getcwd()", "(" * 999]
    )
    def test_metadata_that_are_no_names(self, text):
        with pytest.raises(DetectorError, match="no list of names"):
            names_from_metadata(text, Path("m"))

    def test_from_files(self, tmp_path, monkeypatch):
        files = {
            "n.txt": "red\ngreen\nblue\n\n",
            "n.yaml": "names: {0: red, 1: green, 2: blue}",
            "n.json": '["red", "green", "blue"]',
        }
        (tmp_path / "names").mkdir()
        for name, text in files.items():
            (tmp_path / "names" / name).write_text(text)
        for name in files:  # beside the model, absolute
            assert labels(load(tmp_path, metadata={}, names=f"names/{name}")) == set(COLOURS)
            assert labels(load(tmp_path, metadata={}, names=str(tmp_path / "names" / name))) == set(COLOURS)
        settings = tmp_path / "names" / "settings.yaml"
        settings.write_text("detector: {names: n.txt}")
        monkeypatch.chdir("/")  # beside the settings, wherever the run is started
        assert load_settings(settings).detector.names == str((tmp_path / "names" / "n.txt").resolve())
        assert labels(load(tmp_path, metadata={}, **load_settings(settings).detector.model_dump())) == set(COLOURS)

    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("absent.txt", None, "no names file absent.txt"),
            ("x" * 5000, None, "no names file xxx"),
            ("a\0b", None, "no names file"),
            ("a.txt", b"red\n\nblue\n", "class 1 is empty"),
            ("a.txt", b"", "no name in it"),
            ("a.txt", b"\xff\xfe", "cannot be read"),
            ("a.txt", b"red\ngr\x07een\nblue", "class 1 is empty or not printable"),
            ("a.yaml", b"names: [red", "not YAML"),
            ("a.yaml", b"nothing: here", "no list of names"),
            ("a.txt", b"red\ngreen\n", "there are 2 class names, but the model has 3 classes"),
            ("a.txt", b"red\ngreen\nblue\nblack\n", "there are 4 class names, but the model has 3 classes"),
        ],
    )
    def test_files_that_do_not_fit(self, tmp_path, name, content, message):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        assert message in refused(tmp_path, ConfigError, names=name)

    def test_a_model_without_names(self, tmp_path):
        detector = load(tmp_path, metadata={})
        assert labels(detector) == {"class_0", "class_1", "class_2"}
        assert "names no classes: they are numbered (--names FILE names them)" in detector.warnings[0]
        assert labels(load(tmp_path, "ssd", metadata={})) == {"class_0", "class_1", "class_2"}
        assert labels(load(tmp_path, "ssd", metadata={}, classes=("class_2",))) == {"class_2"}
        assert "needs detector.names" in refused(tmp_path, ConfigError, "ssd", metadata={}, classes=("cup",))

    def test_cocos_names(self, tmp_path):
        assert KNOWN["coco"] == COCO_NAMES
        numbers = {
            1: "person",
            13: "stop sign",
            18: "dog",
            62: "chair",
            77: "cell phone",
            90: "toothbrush",
            12: "N/A",
            83: "N/A",
        }
        assert {n: KNOWN["coco91"][n] for n in numbers} == numbers
        assert labels(load(tmp_path, "ssd", metadata={}, names="coco")) == {"person", "bicycle", "car"}
        assert labels(load(tmp_path, "ssd", metadata={}, names="coco91")) == {"person", "bicycle"}  # 0 is nothing

    def test_numbers_may_begin_with_the_background(self, tmp_path):
        assert labels(load(tmp_path, "ssd_fractions", first_label=1)) == set(COLOURS)
        assert labels(load(tmp_path, "ssd_fractions", names=("background", *COLOURS))) == set(COLOURS)
        assert labels(load(tmp_path, "ssd", first_label=1)) == {"red", "green"}  # 0 is the background
        text = refused(tmp_path, DetectorError, "ssd_fractions")
        assert "gives class 3, but there are 3 names" in text
        assert "first_label" in text


class TestModels:
    def test_no_model(self, tmp_path):
        with pytest.raises(DetectorError, match=r"absent\.onnx: the model cannot be read: No such file"):
            load_detector(tmp_path / "absent.onnx", Settings())
        with pytest.raises(DetectorError, match="cannot be read"):
            load_detector(tmp_path, Settings())
        for content in (b"", b"\xff\xd8\xff\xe0 a photograph", b"PK\x03\x04"):
            (tmp_path / "photo.jpg").write_bytes(content)
            with pytest.raises(DetectorError, match="not an ONNX model") as caught:
                load_detector(tmp_path / "photo.jpg", Settings())
            assert "\n" not in str(caught.value)
            assert "PROTOBUF" not in str(caught.value)

    def test_a_model_cut_off(self, tmp_path):
        whole = tiny_model(tmp_path / "m.onnx", "ssd").read_bytes()
        for share in (0.2, 0.5, 0.9):
            (tmp_path / "cut.onnx").write_bytes(whole[: int(len(whole) * share)])
            with pytest.raises(DetectorError, match=r"cut\.onnx"):
                load_detector(tmp_path / "cut.onnx", Settings())

    def test_inputs_that_an_image_does_not_feed(self, tmp_path):
        extra = [("scale_factor", TensorProto.FLOAT, ["batch", 2])]
        model = tiny_model(tmp_path / "paddle.onnx", "ssd", extra=extra)
        with pytest.raises(DetectorError, match=r"images \[1, 3, 640, 640\] float; scale_factor \[\?, 2\] float \("):
            load_detector(model, Settings())
        sizes = [("orig_target_sizes", TensorProto.STRING, [1, 2])]
        with pytest.raises(DetectorError, match="does not feed"):
            load_detector(tiny_model(tmp_path / "text.onnx", "ssd", extra=sizes), Settings())

    def test_a_model_of_another_task(self, tmp_path):
        assert "task is obb" in refused(tmp_path, DetectorError, metadata={"task": "obb", "names": list(COLOURS)})

    def test_a_model_that_does_not_run(self, tmp_path):
        network = load(tmp_path, "ssd").network
        with pytest.raises(DetectorError, match=r"cannot run the model on images of 640x320") as caught:
            network.run(np.zeros((1, 3, 320, 640), np.float32))
        assert "\n" not in str(caught.value)

    def test_sizes_and_bytes_that_the_model_does_not_take(self, tmp_path):
        text = refused(tmp_path, ConfigError, size=(320, 640))
        assert "detector.size is 320x640, the model takes 640x640" in text
        assert "resize is none" in refused(tmp_path, ConfigError, resize="none")
        model = tiny_model(tmp_path / "b.onnx", "ssd", kind=TensorProto.UINT8, divide_by=1.0)
        with pytest.raises(ConfigError, match="bytes as they are"):
            load_detector(model, Settings(divide_by=255.0))

    def test_outputs_that_are_no_probabilities(self, tmp_path):
        text = refused(tmp_path, DetectorError, divide_by=1.0)
        assert "are no probabilities" in text
        assert "detector.activation" in text
        (found,) = load(tmp_path, divide_by=1.0, activation="sigmoid", min_score=0.9).detect([scene(ONE)])
        assert set(found.labels) == set(COLOURS)

    def test_cuda_where_there_is_none(self, tmp_path, monkeypatch):
        monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
        with pytest.raises(ConfigError, match="no CUDA"):
            load(tmp_path, device="cuda")
        assert load(tmp_path, device="auto").network.session.get_providers() == ["CPUExecutionProvider"]

    def test_threads(self, tmp_path):
        options = load(tmp_path, threads=1).network.session.get_session_options()
        assert options.intra_op_num_threads == 1

    def test_a_key_names_the_model_and_all_that_changes_its_boxes(self, tmp_path):
        keys = {load(tmp_path).key, load(tmp_path, device="cpu", threads=1, batch=3).key}
        assert len(keys) == 1
        for changed in ({"min_score": 0.3}, {"iou": 0.6}, {"names": ("a", "b", "c")}, {"classes": ("red",)}, {"pad": 0}):
            keys.add(load(tmp_path, **changed).key)
        keys.add(load(tmp_path, "yolov5").key)
        assert len(keys) == 7
        (tmp_path / "model.onnx.data").write_bytes(b"weights")  # exporters keep large weights beside the model
        keys.add(load(tmp_path).key)
        assert len(keys) == 8


def test_the_ready_settings_for_a_users_own_model():
    text = (CONFIGS / "yolo.yaml").read_text()
    settings = load_settings(CONFIGS / "yolo.yaml")
    assert settings != load_settings()
    assert load_settings(CONFIGS / "yolo.yaml").detector == settings.detector
    told = {line.split(":")[0].strip(" #") for line in text.splitlines() if line.startswith("  ")}
    assert told >= {"layout", "names", "classes", "min_score", "iou", "outputs"}
    # every line that is commented out would be a valid setting
    opened = yaml.safe_load(re.sub("^  # ", "  ", text, flags=re.MULTILINE))
    assert Settings.model_validate(opened["detector"]).layout == "yolov8"
    assert yaml.safe_load(dump_settings(settings))["detector"]["min_score"] == settings.detector.min_score


def test_a_description_is_json_with_settings(tmp_path):
    described = {"layout": "ssd", "first_label": 0, "resize": "letterbox", "colour": "rgb", "divide_by": 255.0, "nms": True}
    detector = load(tmp_path, "ssd", metadata={"names": json.dumps(COLOURS), "objslam.detector": json.dumps(described)})
    assert (detector.recipe.resize, detector.recipe.nms) == ("letterbox", True)
    (found,) = detector.detect([scene(ONE)])
    order = [found.labels.index(name) for name in COLOURS]
    np.testing.assert_allclose(found.boxes[order], ONE, atol=0.5)
