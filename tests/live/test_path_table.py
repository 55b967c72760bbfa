"""The path of a long session keeps few poses, and a later solve gets the same from them as from the whole path."""

import numpy as np
import pytest
from driving import feed
from quick import NOTHING_BESIDE
from test_session import make_log

from objslam.config import Odometry, load_settings
from objslam.core.geometry import exp_se3, interpolate, lift_se2
from objslam.core.trajectory import Trajectory, travel
from objslam.frontend.corrected_odometry import corrected_odometry
from objslam.frontend.odometry_drift import gathered_drift
from objslam.live.mapper import tables
from objslam.live.mapper.tables import PathTable
from objslam.live.session.finalize import finish
from objslam.live.session.session import Session

NOT_ASKED = np.zeros(0)


def keep(stamps, poses, most, monkeypatch, asked=NOT_ASKED):
    monkeypatch.setattr("objslam.live.mapper.tables._MOST_POSES", most)
    table = PathTable(max_gap=1.1, reach=1.0, newest=5.0)
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        table.append(stamp, pose, asked[asked < stamp])
    return table


def rounds(tilt, seconds=4000.0):
    """A robot at 10 Hz that drives rounds, and some of them on the spot: one every 7 s, which is less than some poses are
    apart in the end."""
    t = np.arange(0, seconds, 0.1)
    speed = np.where(t % 100 < 70, 0.5, 0.0)
    yaw = np.cumsum(0.1 * (0.9 + 0.3 * np.sin(t / 11)))
    x, y = np.cumsum(0.1 * speed * np.cos(yaw)), np.cumsum(0.1 * speed * np.sin(yaw))
    poses = lift_se2(np.stack([x, y, yaw], axis=1))
    return t, poses @ exp_se3(np.array([[tilt, 0.0, 0.0, 0.0, 0.0, 0.0]]))[0]


def test_a_long_path_keeps_few_poses_and_its_gaps(monkeypatch):
    stamps = np.concatenate([np.arange(0, 60, 0.005), np.arange(70, 100, 0.005)])
    poses = lift_se2(np.stack([np.sin(stamps / 5), np.cos(stamps / 5), stamps / 5], axis=1))
    table = keep(stamps, poses, 1000, monkeypatch)
    assert len(table) <= 1000
    kept = table.trajectory()
    assert kept.stamps[0] == stamps[0]
    assert kept.stamps[-1] == stamps[-1]
    wide = np.diff(kept.stamps) > 1.1
    assert wide.sum() == 1  # the gap is there, and no other
    np.testing.assert_allclose(kept.stamps[np.flatnonzero(wide)[0]], 59.995, atol=0.01)
    inside = (stamps < 59.9) | (stamps > 70.1)
    found, _ = interpolate(kept.stamps, kept.poses, stamps[inside], np.inf)
    np.testing.assert_allclose(found, poses[inside], atol=2e-3)  # 0.2 s apart, on a path that does not follow its heading


def test_a_path_below_the_limit_is_as_it_came(monkeypatch):
    stamps, poses = rounds(0.0, 100.0)
    kept = keep(stamps, poses, 1000, monkeypatch).trajectory()
    np.testing.assert_array_equal(kept.stamps, stamps)
    np.testing.assert_array_equal(kept.poses, poses)
    assert kept.travel is None


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_what_solves_ask_for_is_nearly_that_of_the_whole_path(tilt, monkeypatch):
    """Of 40,000 poses, 1500 stay. They are up to 8 s apart, but not where they are asked for."""
    stamps, poses = rounds(tilt)
    asked = np.arange(20.0, 4000.0, 190.0)
    table = keep(stamps, poses, 1500, monkeypatch, asked)
    kept, whole = table.trajectory(), Trajectory(stamps, poses)
    assert len(kept) <= 1500
    assert np.diff(kept.stamps).max() > 4.0
    around = (asked[:, None] + np.linspace(-1.0, 1.0, 9)).ravel()
    found, inside = interpolate(kept.stamps, kept.poses, around, 1.1)
    assert inside.all()
    np.testing.assert_allclose(found, interpolate(stamps, poses, around, 1.1)[0], atol=0.01)
    error = {"odometry.scale": 0.03, "odometry.turn_scale": 0.001, "odometry.turn_bias": 1e-6}
    ways = [(whole, kept), (corrected_odometry(whole, error), corrected_odometry(kept, error))]
    np.testing.assert_allclose(*(interpolate(p.stamps, p.poses, asked, 1.1)[0] for p in ways[1]), atol=0.02)
    noise = Odometry(x_per_m=0.05, y_per_m=0.02, yaw_per_m=0.03, yaw_per_rad=0.04, xy_per_rad=0.02)
    for of_whole, of_kept in ways:
        true, told = (np.diff(gathered_drift(p, asked, noise), axis=0) for p in (of_whole, of_kept))
        sigma = [np.sqrt(np.diagonal(drift, axis1=1, axis2=2)[:, 2:5]) for drift in (told, true)]
        np.testing.assert_allclose(sigma[0][:, 0], sigma[1][:, 0], rtol=1e-3)  # the heading's
        np.testing.assert_allclose(sigma[0], sigma[1], rtol=0.15)  # the place's depends on where the robot turned


def test_where_many_are_asked_for_the_limit_grows(monkeypatch):
    """A solve must not meet a gap that the robot did not have."""
    stamps, poses = rounds(0.0, 400.0)
    kept = keep(stamps, poses, 500, monkeypatch, asked=np.arange(0.0, 400.0, 2.0)).trajectory()
    assert np.diff(kept.stamps).max() < 1.1
    assert len(kept) > 1000


def test_a_session_ends_with_the_same_map_from_fewer_poses():
    """Only the poses between dropped keyframes go: the end estimates the errors of the robot from the rest."""
    log = make_log(seed=2, frames=200, laps=3.0, frame_rate=1.0, odometry_rate=4.0)
    settings = load_settings(None, ("mode=joint", "rays.pixel_sigma=2", "live.max_keyframes=50", *NOTHING_BESIDE))
    session = feed(Session(settings, patient=True).start(), log)
    state = session._mapper.state
    table, stamps = state.course.driven, state.keyframes.stamp
    assert 0 < len(stamps) < 100
    whole, before = finish(state, "live", None), len(table)
    table._spacing, table._most = 4.0, before
    table._thin(stamps)
    fewer = finish(state, "live", None)
    session.abort()
    assert len(fewer.path_after) == len(table) < 0.7 * before
    assert len(whole.map.resolved()) >= 10
    for one, other in zip(whole.map.resolved(), fewer.map.resolved(), strict=True):
        assert one.label == other.label
        apart = one.position - other.position
        assert apart @ np.linalg.solve(one.covariance, apart) < 1.0


def test_no_pose_waits_for_the_sums_of_many(monkeypatch):
    """A path of 3,000 poses, of which some are dropped at 2,000, sums up at most `_SUMMED` steps at a time."""
    steps: list[int] = []
    monkeypatch.setattr(tables, "_MOST_POSES", 2000)
    monkeypatch.setattr(tables, "_SUMMED", 100)
    monkeypatch.setattr(tables, "travel", lambda poses: (steps.append(len(poses) - 1), travel(poses))[1])
    path = PathTable(max_gap=1.0, reach=1.0, newest=1.0)
    pose = np.eye(4)
    for i in range(3000):
        pose[0, 3] = 0.01 * i
        path.append(0.005 * i, pose, np.zeros(0))
    assert max(steps) <= 100
    assert sum(path.trajectory().travel[:, 0]) == pytest.approx(29.99)
