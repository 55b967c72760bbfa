"""Labels that are numbers get the names of a list or of a file."""

import json

import numpy as np
import pytest

from objslam.core.camera import Camera
from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.errors import ConfigError
from objslam.frontend.class_names import load_names, with_names

FILES = {
    "names.txt": "cup\nbook\n tv set \n",
    "data.yaml": "train: images\nnc: 3\nnames:\n  0: cup\n  1: book\n  2: tv set\n",
    "list.yml": "names: [cup, book, tv set]\n",
    "bare.json": json.dumps(["cup", "book", "tv set"]),
    "map.json": json.dumps({"0": "cup", "1": "book", "2": "tv set"}),
}


@pytest.mark.parametrize("name", FILES)
def test_each_kind_of_file_gives_the_same_names(name, tmp_path):
    (tmp_path / name).write_text(FILES[name])
    assert load_names(str(tmp_path / name)) == {0: "cup", 1: "book", 2: "tv set"}
    assert load_names(name, (tmp_path,)) == {0: "cup", 1: "book", 2: "tv set"}


def test_coco_is_known():
    assert [load_names("coco")[number] for number in (0, 39, 41, 79)] == ["person", "bottle", "cup", "toothbrush"]
    ninety_one = load_names("coco91")
    assert tuple(ninety_one[number] for number in sorted(ninety_one)) == COCO_NAMES
    assert (ninety_one[1], ninety_one[44], ninety_one[90]) == ("person", "bottle", "toothbrush")
    assert 12 not in ninety_one


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("names.txt", "", "no name"),
        ("names.txt", "cup\n\nbook\n", "class 1 is empty"),
        ("names.yaml", "{", "not YAML"),
        ("names.yaml", "names: 5", "no list"),
        ("names.yaml", "-1: cup", "no list"),
        ("names.json", "[]", "no list"),
    ],
)
def test_a_file_without_names_is_one_line(name, text, said, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_names(str(tmp_path / name))
    with pytest.raises(ConfigError, match="there is no names file"):
        load_names(str(tmp_path / "missing"))


def log_of(labels, boxes):
    """One frame with boxes of these labels, by their index."""
    count = len(boxes)
    found = Detections(
        frame_stamps=np.zeros(1),
        frame=np.zeros(count, dtype=int),
        boxes=np.tile([1.0, 2.0, 3.0, 4.0], (count, 1)),
        label=np.array(boxes),
        scores=np.ones(count),
        depths=np.full(count, np.nan),
        track_ids=np.full(count, -1),
        label_names=labels,
    )
    camera, path = (
        Camera("front", 640, 480, np.diag([500.0, 500.0, 1.0])),
        Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))),
    )
    truth = Truth((TruthObject(0, "41", np.zeros(3)), TruthObject(1, "lamp", np.zeros(3))))
    return Log("log", (CameraLog(camera, found), CameraLog(Camera("rear", 640, 480, camera.matrix))), path, truth=truth)


def test_numbers_become_names_and_equal_names_one_label():
    ledger = Ledger()
    labels = ("41", "cup", "lamp", "80", "039", "4.0", "²", "1" * 5000)
    named = with_names(log_of(labels, [0, 1, 2, 3, 3, 4, 5, 6, 7]), "coco", ledger)
    found = named.cameras[0].detections
    assert [found.label_names[label] for label in found.label] == [
        *("cup", "cup", "lamp", "80", "80", "bottle", "4.0", "²", "1" * 5000)
    ]
    assert len(set(found.label_names)) == len(found.label_names)
    assert named.cameras[1].detections is None
    assert [one.label for one in named.truth.objects] == ["cup", "lamp"]
    assert ledger.warnings == [f"3 boxes keep a class number that coco does not name: 80, {'1' * 5000}"]


def test_a_log_without_numbers_is_as_it_was():
    ledger, log = Ledger(), log_of(("cup", "lamp"), [1, 0])
    found = with_names(log, "coco", ledger).cameras[0].detections
    assert found.label_names == ("cup", "lamp")
    assert found.label.tolist() == [1, 0]
    assert not ledger.warnings
