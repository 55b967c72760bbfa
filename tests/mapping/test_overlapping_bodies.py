"""Two objects whose bodies fill one space are doubted, unless frames show both."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from objslam.core.bodies.body import Body
from objslam.core.object_map import MapObject
from objslam.mapping.doubts.overlapping import overlapping

NONE = SimpleNamespace(first=np.zeros(0, dtype=int), second=np.zeros(0, dtype=int))


def truck(number, x, label="truck", size=(8.0, 3.0, 3.0), yaw=0.0):
    body = Body("cuboid", np.array(size), yaw, np.full(3, 0.5), 0.1)
    place, spread = np.array([x, 0.0, 1.5]), 0.1 * np.eye(3)
    return MapObject(number, label, place, spread, "ok", 20, 20, 30.0, 0.5, 0.0, 9.0, body=body)


def result(*objects, together=0):
    """A result in which each object has ten boxes. together: the number of frames with boxes of all."""
    count = len(objects)
    keyframe = np.concatenate([np.where(np.arange(10) < together, 0, 100 * i) + np.arange(10) for i in range(count)])
    return SimpleNamespace(
        map=SimpleNamespace(objects=objects),
        rays=SimpleNamespace(keyframe=keyframe),
        association=SimpleNamespace(object=np.repeat(np.arange(count), 10)),
    )


def test_bodies_in_each_other_are_doubted():
    (doubt,) = overlapping(result(truck(3, 0.0), truck(7, 1.0), truck(8, 40.0)), NONE)
    assert doubt.kind == "pair"
    assert doubt.objects == (3, 7)
    assert doubt.numbers["overlap"] == pytest.approx(7 / 9)
    assert "may be one thing:" in doubt.text
    assert len(doubt.rays) == 20


@pytest.mark.parametrize("x", [5.0, 8.1])
def test_bodies_that_hardly_overlap_are_two(x):
    assert not overlapping(result(truck(0, 0.0), truck(1, x)), NONE)


def test_frames_with_both_say_that_they_are_two():
    assert overlapping(result(truck(0, 0.0), truck(1, 1.0), together=2), NONE)
    assert not overlapping(result(truck(0, 0.0), truck(1, 1.0), together=3), NONE)


def test_labels_that_differ_need_more():
    assert not overlapping(result(truck(0, 0.0), truck(1, 3.0, "bus")), NONE)
    (doubt,) = overlapping(result(truck(0, 0.0), truck(1, 1.0, "bus")), NONE)
    assert "one thing with two labels" in doubt.text


def test_other_doubts_and_objects_without_bodies_are_left_out():
    known = SimpleNamespace(first=np.array([0]), second=np.array([1]))
    assert not overlapping(result(truck(0, 0.0), truck(1, 1.0)), known)
    assert not overlapping(result(truck(0, 0.0), replace(truck(1, 1.0), body=None)), NONE)
    assert not overlapping(result(truck(0, 0.0), replace(truck(1, 1.0), status="unresolved")), NONE)
