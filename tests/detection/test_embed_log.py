"""An image encoder on a log: each box gets the vector of what is in it, and what cannot be embedded is told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import call
from onnx import TensorProto, helper
from tiny_models import COLOURS, Graph, scene, tiny_model

import objslam
from objslam.config import Settings
from objslam.config.settings import change_settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Images
from objslam.detection import embed_log, load_encoder
from objslam.errors import ConfigError, DetectorError, LogError
from objslam.io.detections_jsonl import read_detections

PLAIN = {"divide_by": 255, "mean": [0, 0, 0], "std": [1, 1, 1]}
BOXES = [[20, 30, 90, 100], [200, 40, 240, 90], [120, 150, 180, 200]]  # They are red, green and blue.


def encoder(
    path: Path, *, batch: int | None = None, size: int | None = 8, outputs: tuple[str, ...] = ("pool",), **metadata: object
) -> Path:
    """An encoder whose vector is the mean colour of the crop, as (B, 3, 1, 1) of a pooling or as (B, 3)."""
    graph = Graph()
    pool = graph("GlobalAveragePool", "image")
    known = {"pool": pool, "features": graph("Flatten", pool), "map": graph("Relu", "image")}
    made = [graph.rename(known[name], name) for name in outputs]
    given = helper.make_tensor_value_info("image", TensorProto.FLOAT, [batch, 3, size, size])
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in made]
    return Path(graph.save(path, [given], found, metadata))


@pytest.fixture
def log(tmp_path: Path) -> objslam.Log:
    """Three images of three rectangles. The boxes of the second frame are twice as wide as these."""
    (tmp_path / "log").mkdir()
    files = tuple(tmp_path / "log" / f"{i}.png" for i in range(3))
    for file in files:
        cv2.imwrite(str(file), scene(BOXES, 320, 240))
    stamps = 10 + 0.1 * np.arange(3)
    wide = [[x1 - (x2 - x1) / 2, y1, x2 + (x2 - x1) / 2, y2] for x1, y1, x2, y2 in BOXES]
    detections = objslam.Detections.from_frames(stamps, [BOXES, wide, BOXES], [COLOURS] * 3)
    camera = CameraLog(Camera("front", 320, 240, np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]])), detections)
    path = objslam.Trajectory.from_arrays(stamps, [[0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]])
    return objslam.Log("log", (replace(camera, rgb=Images(stamps, files)),), localization=path)


def features(log: objslam.Log, model: Path, settings: Settings | None = None, ledger: Ledger | None = None) -> np.ndarray:
    found = embed_log(log, load_encoder(model, settings or Settings()), ledger or Ledger()).cameras[0].detections
    assert found is not None
    assert found.features is not None
    return found.features


@pytest.mark.parametrize("outputs", [("pool",), ("features",), ("map", "features"), ("pool", "features")])
@pytest.mark.parametrize(("batch", "size"), [(None, 8), (None, None), (1, 8), (4, 8)])
def test_each_box_has_the_vector_of_its_crop(
    log: objslam.Log, tmp_path: Path, outputs: tuple[str, ...], batch: int | None, size: int | None
) -> None:
    model = encoder(tmp_path / "m.onnx", batch=batch, size=size, outputs=outputs, **{"objslam.encoder": PLAIN})
    found = features(log, model)
    assert found.shape == (9, 3)
    for one in (found[:3], found[6:]):
        np.testing.assert_allclose(one, np.eye(3), atol=0.05)
    # Half of a wide box is background, which has the same value in each channel.
    assert (found[3:6].argmax(axis=1) == [0, 1, 2]).all()
    assert found[3:6].min() > 0.1


def test_the_normalisation_is_that_of_imagenet_or_of_the_settings(log: objslam.Log, tmp_path: Path) -> None:
    model = encoder(tmp_path / "m.onnx")
    red = (np.array([1.0, 0.0, 0.0]) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(features(log, model)[0], red / np.linalg.norm(red), atol=0.03)
    plain = change_settings(Settings(), {"encoder": {**PLAIN, "colour": "bgr"}})
    np.testing.assert_allclose(features(log, model, plain)[:3], np.eye(3)[::-1], atol=0.05)


def test_a_margin_shows_the_surroundings(log: objslam.Log, tmp_path: Path) -> None:
    model = encoder(tmp_path / "m.onnx", **{"objslam.encoder": PLAIN})
    found = features(log, model, change_settings(Settings(), {"encoder.margin": 0.5}))
    assert found[:3].min() > 0.1


def test_frames_and_images_that_do_not_fit_are_counted(log: objslam.Log, tmp_path: Path) -> None:
    (camera,), model = log.cameras, encoder(tmp_path / "m.onnx")
    assert camera.rgb is not None
    camera.rgb.paths[1].write_bytes(b"no image")
    lost = replace(camera, rgb=Images(camera.rgb.stamps + np.array([0.0, 0.0, 0.05]), camera.rgb.paths))
    ledger = Ledger()
    found = features(replace(log, cameras=(lost,)), model, ledger=ledger)
    assert np.isnan(found).all(axis=1).tolist() == [False] * 3 + [True] * 6
    assert ledger.dropped == {"features of a frame without an rgb image": 1, "rgb image that cannot be decoded": 1}
    for none in (replace(camera, rgb=None), replace(camera, rgb=Images(camera.rgb.stamps + 1, camera.rgb.paths))):
        with pytest.raises(LogError, match="no box has an rgb image"):
            embed_log(replace(log, cameras=(none,)), load_encoder(model, Settings()), Ledger())


@pytest.mark.parametrize(
    ("outputs", "settings", "error", "word"),
    [
        (("map",), {}, DetectorError, "no output holds one vector per image: map"),
        (("features",), {"encoder.output": "none"}, ConfigError, "has no output 'none'"),
        (("map", "features"), {"encoder.output": "map"}, DetectorError, "no output holds"),
        (("features",), {"encoder.size": [9, 9]}, ConfigError, "encoder.size is 9x9, the model takes 8x8"),
    ],
)
def test_a_model_that_is_no_encoder_is_told(
    tmp_path: Path, outputs: tuple[str, ...], settings: dict[str, object], error: type[Exception], word: str
) -> None:
    with pytest.raises(error, match=word):
        load_encoder(encoder(tmp_path / "m.onnx", outputs=outputs), change_settings(Settings(), settings))


def test_a_wrong_description_of_a_model_is_told(tmp_path: Path) -> None:
    for text in ("[", {"mean": 1}, {"batch": 2}):
        with pytest.raises(DetectorError, match=r"objslam.encoder in the model's metadata is wrong"):
            load_encoder(encoder(tmp_path / "m.onnx", **{"objslam.encoder": text}), Settings())


def test_a_run_writes_boxes_with_vectors_that_a_log_can_use(log: objslam.Log, tmp_path: Path) -> None:
    result = objslam.run(log, {"output": {"picture": False, "recording": False}}, embed=encoder(tmp_path / "m.onnx"))
    result.save(tmp_path / "out")
    found = read_detections(tmp_path / "out" / "detections.jsonl", Ledger())
    assert found.features is not None
    np.testing.assert_array_equal(found.features, features(log, tmp_path / "m.onnx"))


def test_the_command_for_one_photo_tells_the_vectors(log: objslam.Log, tmp_path: Path) -> None:
    detector = tiny_model(tmp_path / "d.onnx", "yolov8", metadata={"names": dict(enumerate(COLOURS))})
    model = encoder(tmp_path / "m.onnx", **{"objslam.encoder": PLAIN})
    assert log.cameras[0].rgb is not None
    words = ["detect", str(detector), str(log.cameras[0].rgb.paths[0]), "--embed", str(model), "--json"]
    done = call(*words)
    assert done.code == 0, done.err
    for row in json.loads(done.out)["boxes"]:
        assert int(np.argmax(row["features"])) == COLOURS.index(row["label"])
