"""A drive of another day is found in a map, takes over its frame, and is refused by the map of another room."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import Settings
from objslam.config.settings import change_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, lift_se2
from objslam.core.object_map import ObjectMap
from objslam.mapping.localization import PriorMap, moved_log
from objslam.mapping.pipeline import run
from objslam.simulation import preset, simulate

UNKNOWN = lift_se2(np.array([3.0, -7.0, 2.0]))


def settings(mode="fixed"):
    poses = {"use": "odometry" if mode == "joint" else "localization"}
    less = {"checks": {"use": False}, "bodies": {"use": False}, "output": {"recording": False, "picture": False}}
    camera = {"calibration": {"centre": 0.0}}  # The simulated camera is calibrated.
    return change_settings(Settings(), {"mode": mode, "poses": poses, **less, **camera})


def another_day(first, seed):
    """Another drive through the room of the first, in the same frame."""
    objects = tuple((o.label, tuple(o.position)) for o in first.truth.objects)
    return simulate(preset("demo", objects=0, placed=objects, path=(3, 2), frames=160), seed)


@pytest.fixture(scope="module")
def days():
    first = simulate(preset("demo"), 2)
    return first, another_day(first, 102)


@pytest.fixture(scope="module")
def known(days):
    return PriorMap("yesterday", run(days[0], settings(), Ledger()).map)


def ate(result, log):
    true = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, result.keyframes.stamps, 1.0)[0]
    return np.sqrt((np.linalg.norm((result.map_T_base - true)[:, :3, 3], axis=1) ** 2).mean())


def deviations(result, log):
    """The squared Mahalanobis distance of each object from the true one of its label that is nearest."""
    found = []
    for o in result.map.resolved():
        off = min((o.position - t.position for t in log.truth.objects if t.label == o.label), key=np.linalg.norm)
        found.append(off @ np.linalg.solve(o.covariance, off))
    return np.array(found)


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_a_drive_from_an_unknown_start_is_found_in_the_map(days, known, mode):
    before = known.objects.positions.copy()
    ledger = Ledger()
    result = run(moved_log(days[1], UNKNOWN), settings(mode), ledger, known=known)
    told = result.summary["localisation"]
    assert told["localised"]
    assert told["objects"] == 12
    assert not any("localised" in line for line in ledger.lines())
    assert ate(result, days[1]) < 0.05  # In joint mode, odometry alone drifts by 0.25 m.
    assert (deviations(result, days[1]) < 11.345).all()
    np.testing.assert_array_equal(known.objects.positions, before)
    by_id = {o.id: o for o in known.objects}
    for o in result.map:
        assert by_id[o.id].label == o.label  # All of them are in the map.
        assert np.linalg.norm(by_id[o.id].position - o.position) < 0.05
        assert o.sigma < 1.5 * by_id[o.id].sigma
    begin, end = result.path_after.poses[[0, -1], :3, 3]
    true = days[1].truth.trajectory.poses[[0, -1], :3, 3]
    assert np.linalg.norm([begin - true[0], end - true[1]], axis=1).max() < 0.1  # The whole path went over.


def test_a_new_object_gets_a_new_id(days, known):
    fewer = replace(known.objects, objects=known.objects.objects[:-2])
    result = run(moved_log(days[1], UNKNOWN), settings(), Ledger(), known=PriorMap("fewer", fewer))
    ids = [o.id for o in result.map]
    assert len(set(ids)) == len(ids)
    new = set(ids) - {o.id for o in fewer}
    assert len(new) == 2
    assert min(new) >= 10  # After the last id of the map.
    assert (deviations(result, days[1]) < 11.345).all()


def test_the_map_of_another_room_refuses_the_drive(days):
    other = PriorMap("elsewhere", run(simulate(preset("demo"), 5), settings(), Ledger()).map)
    log, ledger = moved_log(days[1], UNKNOWN), Ledger()
    result, alone = run(log, settings(), ledger, known=other), run(log, settings(), Ledger())
    assert not result.summary["localisation"]["localised"]
    assert sum(line.startswith("not localised in elsewhere: too little evidence") for line in ledger.lines()) == 1
    np.testing.assert_array_equal(result.map.positions, alone.map.positions)
    np.testing.assert_array_equal(result.map_T_base, alone.map_T_base)


def test_an_empty_map_says_why(days):
    ledger = Ledger()
    result = run(days[1], settings(), ledger, known=PriorMap("empty", ObjectMap(())))
    assert "the map has no resolved object" in result.summary["localisation"]["line"]


Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(("drive", "up", "who"), [(Y_DOWN, "z", "the drive"), (np.eye(4), "-y", "the map")])
def test_a_drive_or_a_map_on_its_side_is_the_reason(days, drive, up, who):
    known = PriorMap("lying", ObjectMap(()), up)
    told = run(moved_log(days[1], drive), settings(), Ledger(), known=known).summary["localisation"]
    assert not told["localised"]
    assert told["reason"] == f"{who} lies on its side (up is -y); maps are matched only with z up"
