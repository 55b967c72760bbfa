"""Rotations of fiducials against true ones, after an alignment, and their way through the files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.core.bodies.tag_pose import TagPose
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Truth, TruthObject
from objslam.errors import LogError
from objslam.evaluation.evaluate import evaluate
from objslam.evaluation.table import evaluation_table
from objslam.io.objects_json import dump_truth_objects, read_truth_objects

PLACES = np.array([[0.0, 0, 0.4], [4, 0, 0.4], [0, 5, 0.4], [3, 3, 0.4]])


def mapped(turns, sigma, other=None):
    tags = [
        TagPose(turn.as_quat(), sigma**2 * np.eye(3), 0.2, 0.0, other, 0.1 if other is not None else 0.0) for turn in turns
    ]
    return ObjectMap(
        tuple(
            MapObject(i, f"tag_{i}", place, 1e-4 * np.eye(3), "ok", 5, 5, 20.0, 0.1, 0.0, 1.0, tag=tag)
            for i, (place, tag) in enumerate(zip(PLACES, tags, strict=True))
        )
    )


def test_rotations_are_compared_after_the_alignment():
    frame, shift = Rotation.from_euler("z", 0.8), np.array([3.0, -1.0, 0.0])
    turns = Rotation.random(4, random_state=1)
    off = Rotation.from_rotvec(np.radians([[3.0, 0, 0], [0, 1, 0], [0, 0, 2], [1, 1, 1]]))
    true = [frame * turn for turn in turns]
    objects = [
        TruthObject(i, f"tag_{i}", frame.apply(place) + shift, tag_xyzw=turn.as_quat())
        for i, (place, turn) in enumerate(zip(PLACES, true, strict=True))
    ]
    found = evaluate(
        mapped([a * b for a, b in zip(turns, off, strict=True)], np.radians(1)), Truth(tuple(objects)), align="se2"
    )
    scores = found.to_dict()
    assert scores["tags"] == 4
    assert scores["rotation_error_deg_max"] == pytest.approx(3.0)
    assert scores["rotation_error_deg_median"] == pytest.approx((np.sqrt(3) + 2) / 2)
    assert scores["rotation_inside_95"] == 0.75  # 3 degrees are three standard deviations.
    assert [o["rotation_error_deg"] for o in scores["objects"]] == pytest.approx([3.0, 1.0, 2.0, np.sqrt(3)])
    assert evaluation_table(found) is not None


def test_the_second_rotation_may_be_the_true_one():
    turn = Rotation.from_euler("x", 0.5)
    objects = tuple(TruthObject(i, f"tag_{i}", place, tag_xyzw=turn.as_quat()) for i, place in enumerate(PLACES))
    scores = evaluate(mapped([turn.inv()] * 4, 0.01, turn.as_quat()), Truth(objects)).to_dict()
    assert scores["rotation_inside_95"] == 1.0
    assert scores["rotation_error_deg_median"] == pytest.approx(np.degrees(1.0))


def test_without_true_rotations_nothing_is_compared():
    truth = Truth(tuple(TruthObject(i, f"tag_{i}", place) for i, place in enumerate(PLACES)))
    scores = evaluate(mapped(Rotation.random(4, random_state=2), 0.01), truth).to_dict()
    assert (scores["tags"], scores["rotation_error_deg_median"]) == (0, None)


def test_true_rotations_return_from_their_file(tmp_path):
    turn = Rotation.random(random_state=3).as_quat()
    (tmp_path / "truth.json").write_text(dump_truth_objects((TruthObject(1, "tag_1", np.zeros(3), tag_xyzw=turn),)), "utf-8")
    (again,) = read_truth_objects(tmp_path / "truth.json")
    np.testing.assert_array_equal(again.tag_xyzw, turn)
    text = (tmp_path / "truth.json").read_text("utf-8")
    (tmp_path / "wrong.json").write_text(text.replace("rotation_xyzw", "rotation"), "utf-8")
    with pytest.raises(LogError, match="rotation_xyzw"):
        read_truth_objects(tmp_path / "wrong.json")
