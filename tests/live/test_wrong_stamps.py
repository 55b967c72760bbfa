"""A single wrong stamp, of any publisher, costs that message and no other, and ends no view of the map."""

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.snapshot import Snapshot
from objslam.core.trajectory import Trajectory
from objslam.live.counters import Counters
from objslam.live.dds.publisher import TOPICS, messages_of
from objslam.live.session.intake import Intake
from objslam.output.export.map_messages import MapMessages
from objslam.sources.journal.records import FrameMessage, MountMessage, PoseMessage

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
BOX = np.array([[10.0, 10.0, 90.0, 90.0]])
KINDS = ("odometry", "localization", "frame", "mount")


def at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


class Robot:
    """An intake that knows the camera, and the stamps of the messages that it delivered, by kind."""

    def __init__(self):
        self.heard = {kind: [] for kind in KINDS}
        self.entry = Intake(load_settings(None, ("mode=joint",)), Counters(), self.deliver)
        self.entry.push_camera(CAMERA)

    def deliver(self, message, arrival):
        if isinstance(message, PoseMessage):
            self.heard[message.path].append(message.stamp)
        elif isinstance(message, FrameMessage | MountMessage):
            self.heard["frame" if isinstance(message, FrameMessage) else "mount"].append(message.stamp)
        return True

    def push(self, kind, stamp):
        if kind == "frame":
            return self.entry.push_detections(stamp, "front", BOX, ["cup"], [0.9])
        if kind == "mount":
            return self.entry.push_mount(stamp, "front", np.eye(4))
        return getattr(self.entry, f"push_{kind}")(stamp, at(0.001 * stamp))

    def dropped(self):
        return sum(self.entry.counters.dropped().values())


RATES = {"odometry": 200.0, "localization": 10.0, "frame": 20.0, "mount": 50.0}


def drive(rates, seconds, start=0.0):
    """The messages of a robot in the order of their stamps: (stamp, kind)."""
    return sorted((start + i / rate, kind) for kind, rate in rates.items() for i in range(round(seconds * rate)))


def without(rates, *kinds):
    return {kind: rate for kind, rate in rates.items() if kind not in kinds}


@pytest.mark.parametrize("ahead", [0.5, 2.0, 10.0, 60.0, 70.0, 1e4, 1.7e9])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rates", [RATES, without(RATES, "localization"), without(RATES, "odometry")], ids=len)
def test_one_stamp_ahead_costs_one_message(ahead, kind, rates):
    robot = Robot()
    for number, (stamp, name) in enumerate(good := drive(rates, 2.0)):
        if number == len(good) // 2 and kind in rates:
            robot.push(kind, stamp + ahead)
        assert robot.push(name, stamp)
    for name in rates:
        assert robot.heard[name] == pytest.approx([stamp for stamp, other in good if other == name])
    assert robot.dropped() == (kind in rates)


@pytest.mark.parametrize("ahead", [0.5, 2.0, 60.0, 1e6])
@pytest.mark.parametrize("rates", [RATES, without(RATES, "odometry"), {"odometry": 1.0, "frame": 3.0}], ids=len)
def test_a_real_step_of_the_clock_costs_nothing(ahead, rates):
    robot = Robot()
    good = drive(rates, 6.0) + drive(rates, 6.0, 6.0 + ahead)
    for stamp, name in good:
        robot.push(name, stamp)
    for name in rates:
        assert robot.heard[name] == pytest.approx([stamp for stamp, other in good if other == name])
    assert robot.dropped() == 0


def test_a_wrong_stamp_in_a_real_gap_costs_one_message():
    robot = Robot()
    for stamp in (0.0, 0.1, 0.2, 500.0, 700.0, 500.1, 500.2, 500.3):
        robot.push("odometry", stamp)
    assert robot.heard["odometry"] == [0.0, 0.1, 0.2, 500.0, 500.1, 500.2, 500.3]
    assert robot.dropped() == 1


@pytest.mark.parametrize("ahead", [0.5, 10.0, 1e4])
def test_after_the_clock_is_set_back_a_stamp_ahead_costs_one_message_too(ahead):
    robot = Robot()
    for stamp, name in drive(RATES, 3.0, 1000.0):
        robot.push(name, stamp)
    for stamp, name in drive(RATES, 1.0):
        robot.push(name, stamp)
    before, lost = {name: len(robot.heard[name]) for name in RATES}, robot.dropped()
    assert robot.entry.counters.accepted()["clock set back"] == 1
    for number, (stamp, name) in enumerate(good := drive(RATES, 3.0, 1.0)):
        if number == len(good) // 2:
            robot.push("odometry", stamp + ahead)
        robot.push(name, stamp)
    assert {name: len(robot.heard[name]) - before[name] for name in RATES} == {n: round(3 * r) for n, r in RATES.items()}
    assert robot.dropped() == lost + 1


@pytest.mark.parametrize("seed", range(10))
def test_lags_and_pauses_are_no_steps(seed):
    """Publishers of any rate that lag and pause, and now and then a single wrong stamp."""
    rng = np.random.default_rng(seed)
    robot, sent, wrong = Robot(), [], 0
    for kind in KINDS:
        step = 1 / (rng.uniform(20, 200) if kind == "odometry" else rng.uniform(2, 50))
        steps = step * rng.uniform(0.8, 1.2, 2000)
        if kind != "odometry":
            steps[rng.random(2000) < 0.02] = rng.uniform(0.5, 5.0)  # it pauses
        stamps, lag = 5.0 + np.cumsum(steps), rng.uniform(0.0, 0.5)
        sent += [(stamp + lag, stamp, kind) for stamp in stamps[stamps < 12.0].tolist()]
    good = {kind: [stamp for _, stamp, name in sorted(sent) if name == kind] for kind in KINDS}
    for _, stamp, kind in sorted(sent):
        if stamp > 7.0 and rng.random() < 0.01:
            robot.push(kind, stamp + 2.0 + 10 ** rng.uniform(-0.3, 5))
            wrong += 1
        robot.push(kind, stamp)
    robot.entry.end()
    for kind in KINDS:
        assert robot.heard[kind] == pytest.approx(good[kind])
    assert robot.dropped() == wrong
    assert wrong > 0


def test_localisation_takes_over_when_odometry_falls_silent():
    robot = Robot()
    for tenth in range(10):
        robot.push("odometry", 0.1 * tenth)
    for stamp in range(100, 110):
        robot.push("localization", float(stamp))
    assert robot.heard["localization"] == list(range(100, 110))


def test_a_stamp_ahead_that_nothing_follows_is_counted():
    robot = Robot()
    for stamp in (0.0, 0.1, 0.2, 50.0):
        assert robot.push("odometry", stamp)
    robot.entry.end()
    assert robot.heard["odometry"] == [0.0, 0.1, 0.2]
    assert robot.dropped() == 1


@pytest.mark.parametrize("stamp", [1e18, -1e11, 2.0**31, np.nan])
def test_a_stamp_that_ros_cannot_express_is_published_as_unset(stamp):
    path = Trajectory(np.array([0.0 if np.isnan(stamp) else stamp]), np.eye(4)[None])
    maker = MapMessages("map")
    for name, message in messages_of(Snapshot(stamp, ObjectMap(()), path), maker).items():
        maker.store.serialize_cdr(message, TOPICS[name])
