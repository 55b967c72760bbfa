"""The command `objslam detect` on one photo: the boxes are those that are in it, and the picture shows them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import Call, call
from tiny_models import scene, tiny_model
from waiting import LIMIT

BOXES = {"red": (100, 120, 180, 200), "green": (300, 60, 380, 180), "blue": (420, 300, 560, 380)}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A model and a photo of three rectangles."""
    at = tmp_path_factory.mktemp("detect")
    model = tiny_model(at / "tiny.onnx", "yolov8", metadata={"names": {0: "red", 1: "green", 2: "blue"}})
    cv2.imwrite(str(at / "photo.png"), scene(list(BOXES.values())))
    return model, at / "photo.png"


def detect(*arguments: object) -> Call:
    return call("detect", *arguments)


def detect_in_process_of_its_own(*arguments: object) -> Call:
    """Native libraries write to the process, and not to `sys.stderr`."""
    words = [sys.executable, "-m", "objslam", "detect", *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, check=False)
    return Call(done.returncode, done.stdout, done.stderr)


def test_the_boxes_are_told_and_drawn(files: tuple[Path, Path], tmp_path: Path) -> None:
    done = detect(*files, "-o", tmp_path / "out.png")
    assert done.code == 0, done.err
    assert "yolov8 layout" in done.out
    assert "3 boxes" in done.out
    drawn, photo = cv2.imread(str(tmp_path / "out.png")), cv2.imread(str(files[1]))
    assert drawn is not None
    assert photo is not None
    changed = np.argwhere((drawn != photo).any(axis=2))[:, ::-1]
    for x1, y1, x2, y2 in BOXES.values():  # a corner of each box is drawn, its middle is not
        assert (np.abs(changed - (x2, y2)).max(axis=1) <= 3).any()
        assert not (np.abs(changed - ((x1 + x2) // 2, (y1 + y2) // 2)).max(axis=1) <= 3).any()


def test_units_that_only_the_values_tell_are_said_in_words(files: tuple[Path, Path], tmp_path: Path) -> None:
    model = tiny_model(tmp_path / "ssd.onnx", "ssd")
    done = detect(model, files[1])
    assert done.code == 0, done.err
    assert "boxes as xyxy in pixels or fractions, decided by their values" in done.out


def test_only_a_picture_is_written(files: tuple[Path, Path], tmp_path: Path) -> None:
    refused = detect(*files, "-o", tmp_path / "boxes.txt")
    assert refused.code == 2
    assert "PNG or JPEG" in refused.err
    assert not (tmp_path / "boxes.txt").exists()
    assert detect(*files, "-o", tmp_path / "boxes.jpg").code == 0
    assert (tmp_path / "boxes.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_json_has_every_box(files: tuple[Path, Path]) -> None:
    told = json.loads(detect(*files, "--json").out)
    assert told["image"] == [640, 480]
    found = {one["label"]: one["box"] for one in told["boxes"]}
    assert set(found) == set(BOXES)
    for label, box in BOXES.items():
        np.testing.assert_allclose(found[label], box, atol=2)


@pytest.mark.parametrize(
    ("model", "photo", "word"),
    [("none.onnx", "photo.png", "none.onnx"), ("m", "no.txt", "no image"), ("m", "cut.bmp", "no image")],
)
def test_what_is_wrong_is_one_line(files: tuple[Path, Path], tmp_path: Path, model: str, photo: str, word: str) -> None:
    """Also where OpenCV would print lines of its own."""
    (tmp_path / "no.txt").write_text("text")
    whole = cv2.imencode(".bmp", np.zeros((24, 32, 3), dtype=np.uint8))[1].tobytes()
    (tmp_path / "cut.bmp").write_bytes(whole[:200])
    place = files[1].parent if photo == "photo.png" else tmp_path
    done = detect_in_process_of_its_own(tmp_path / model, place / photo)
    assert done.code == 1
    assert len(done.err.strip().splitlines()) == 1
    assert word in done.err
