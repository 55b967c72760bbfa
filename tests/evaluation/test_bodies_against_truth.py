"""Bodies of a map against true bodies, after an alignment, and their way through the files."""

import numpy as np
import pytest

from objslam.core.bodies.body import Body
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Truth, TruthObject
from objslam.evaluation.evaluate import evaluate
from objslam.evaluation.table import evaluation_table
from objslam.io.objects_json import dump_objects, dump_truth_objects, read_objects, read_truth_objects


def thing(number, position, yaw, shape="cuboid"):
    body = Body(shape, np.array([1.1, 0.5, 0.8]), yaw, np.array([0.1, 0.2, 0.3]), 0.4)
    return MapObject(
        number, "shelf", position, 0.01 * np.eye(3), "ok", 5, 5, 20.0, 0.1, 0.0, 1.0, body=body, ray_point=position + 0.1
    )


def test_sizes_yaws_and_overlaps_are_compared_after_the_alignment():
    angle, shift = 0.8, np.array([3.0, -1.0, 0.0])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    places = np.array([[0.0, 0, 0.4], [4, 0, 0.4], [0, 5, 0.4], [3, 3, 0.4]])
    found = ObjectMap(tuple(thing(i, place, 0.3) for i, place in enumerate(places)))
    size = np.array([1.0, 0.5, 0.8])
    truth = Truth(tuple(TruthObject(i, "shelf", turn @ place + shift, size, 0.35 + angle) for i, place in enumerate(places)))
    data = evaluate(found, truth, align="se2", radius=1.0)
    scores = data.to_dict()
    assert scores["bodies"] == 4
    assert scores["size_error_median"] == pytest.approx(0.1 / 3)
    assert scores["yaw_error_deg_median"] == pytest.approx(np.degrees(0.05), abs=1e-3)
    assert 0.8 < scores["iou_median"] < 0.91
    assert evaluation_table(data) is not None


def test_a_point_and_a_truth_without_size_are_not_compared():
    found = ObjectMap((thing(0, np.zeros(3), 0.3),))
    scores = evaluate(found, Truth((TruthObject(0, "shelf", np.zeros(3)),))).to_dict()
    assert (scores["bodies"], scores["iou_median"]) == (0, None)


def test_bodies_and_true_sizes_return_from_their_files(tmp_path):
    objects = ObjectMap((thing(0, np.array([1.0, 2.0, 3.0]), -0.7, "ellipsoid"),))
    (tmp_path / "objects.json").write_text(dump_objects(objects), "utf-8")
    (again,) = read_objects(tmp_path / "objects.json")
    body = objects[0].body
    assert (again.body.shape, again.body.yaw, again.body.yaw_sigma) == (body.shape, body.yaw, body.yaw_sigma)
    np.testing.assert_array_equal(again.body.size, body.size)
    np.testing.assert_array_equal(again.body.size_sigma, body.size_sigma)
    np.testing.assert_array_equal(again.ray_point, objects[0].ray_point)
    truth = (TruthObject(3, "shelf", np.ones(3), np.array([3.0, 2.0, 1.0]), 0.2), TruthObject(4, "cup", np.zeros(3)))
    (tmp_path / "truth.json").write_text(dump_truth_objects(truth), "utf-8")
    first, second = read_truth_objects(tmp_path / "truth.json")
    assert (first.size.tolist(), first.yaw) == ([3.0, 2.0, 1.0], 0.2)
    assert (second.size, second.yaw) == (None, None)
