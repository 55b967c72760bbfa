"""A single wrong stamp, of any publisher, costs that message and no other, and ends no view of the map."""

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.snapshot import Snapshot
from objslam.core.types import Trajectory
from objslam.live.counters import Counters
from objslam.live.dds.publisher import TOPICS, messages_of
from objslam.live.session.intake import Intake
from objslam.output.export.map_messages import MapMessages

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
BOX = np.array([[10.0, 10.0, 90.0, 90.0]])


def intake():
    return Intake(load_settings(None, ("mode=joint",)), Counters(), lambda message, arrival: True)


def at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


@pytest.mark.parametrize("wrong", [70.0, 1e4, 1.7e9])
@pytest.mark.parametrize("path", ["odometry", "localization"])
@pytest.mark.parametrize("both", [False, True])
def test_one_stamp_from_the_future_starves_nobody(wrong, path, both):
    entry = intake()
    entry.push_camera(CAMERA)
    paths = ("odometry", "localization") if both else (path,)
    for tenth in range(100):
        for name in paths:
            push = getattr(entry, f"push_{name}")
            if name == path and tenth == 50:
                assert not push(wrong, at(0.01 * tenth))
            assert push(0.1 * tenth, at(0.01 * tenth))
        assert entry.push_detections(0.1 * tenth, "front", BOX, ["cup"], [0.9])
    assert sum(entry.counters.dropped().values()) == 1


def test_a_real_gap_costs_one_pose():
    entry = intake()
    taken = [entry.push_odometry(stamp, at(0.0)) for stamp in (0.0, 0.1, 500.0, 500.1, 500.2)]
    assert taken == [True, True, False, True, True]


def test_localisation_takes_over_when_odometry_falls_silent():
    entry = intake()
    for tenth in range(10):
        assert entry.push_odometry(0.1 * tenth, at(0.0))
    assert all(entry.push_localization(float(stamp), at(0.0)) for stamp in range(30, 40))


def test_a_localisation_far_ahead_takes_over_at_the_second_pose_in_a_row():
    entry = intake()
    for tenth in range(10):
        assert entry.push_odometry(0.1 * tenth, at(0.0))
    taken = [entry.push_localization(float(stamp), at(0.0)) for stamp in range(100, 110)]
    assert taken == [False] + 9 * [True]


@pytest.mark.parametrize("stamp", [1e18, -1e11, 2.0**31, np.nan])
def test_a_stamp_that_ros_cannot_express_is_published_as_unset(stamp):
    path = Trajectory(np.array([0.0 if np.isnan(stamp) else stamp]), np.eye(4)[None])
    maker = MapMessages("map")
    for name, message in messages_of(Snapshot(stamp, ObjectMap(()), path), maker).items():
        maker.store.serialize_cdr(message, TOPICS[name])
