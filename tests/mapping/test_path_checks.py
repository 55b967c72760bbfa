"""Jumps and restarts of paths, on drives of which it is known where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.localization.localization_jumps import find_jumps
from objslam.frontend.odometry_restarts import counts_from_zero
from objslam.mapping.checks.path import check_path
from objslam.simulation import preset, simulate

FIXED, JOINT = (load_settings(None, (f"mode={mode}",)) for mode in ("fixed", "joint"))
RATE = 0.4  # rad/s, of a robot that drives along a circle with a radius of 1.5 m.


def circle(every: float, noise: float = 0.0, seconds: float = 60.0) -> Trajectory:
    """A drive at 0.6 m/s that stops for 5 s each 20 s. every: s between poses. noise: of places, m."""
    stamps = np.arange(0.0, seconds, every)
    fine = np.arange(0.0, seconds, 0.01)
    angle = np.interp(stamps, fine, np.cumsum(np.where(fine % 20 < 15, RATE, 0.0)) * 0.01)
    places = 1.5 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    places = places + np.random.default_rng(0).normal(0, noise, places.shape)
    return Trajectory(stamps, lift_se2(np.column_stack([places, angle])))


def jumped(path: Trajectory, after: float, way: float) -> Trajectory:
    """The path, `way` m aside after a stamp."""
    poses = path.poses.copy()
    poses[path.stamps > after, 1, 3] += way
    return replace(path, poses=poses)


def names(localization: Trajectory | None, odometry: Trajectory | None = None) -> list[str]:
    return [one.name for one in check_path(Log("log", (), localization=localization, odometry=odometry), FIXED)]


@pytest.mark.parametrize(("every", "noise"), [(0.1, 0.0), (0.1, 0.03), (0.05, 0.05), (0.5, 0.03), (1.0, 0.0)])
def test_a_drive_with_stops_does_not_jump(every: float, noise: float) -> None:
    assert names(circle(every, noise)) == []
    assert names(circle(every, noise), circle(0.05)) == []


def test_a_localisation_that_repeats_each_pose_does_not_jump() -> None:
    path, slow = circle(0.1), np.repeat(np.arange(0, 600, 10), 10)
    assert names(replace(path, poses=path.poses[slow])) == []


@pytest.mark.parametrize("back", [None, 40.0])
def test_a_jump_of_half_a_metre_is_named(back: float | None) -> None:
    """At 10 Hz it is slower than 5 m/s, but no robot accelerates and brakes so."""
    path = jumped(circle(0.1, 0.03), 30.0, 0.55)
    path = path if back is None else jumped(path, back, -0.55)
    (found,) = check_path(Log("log", (), localization=path), FIXED)
    assert found.name == "localisation jumps"
    assert not found.spoils
    assert f"jumps {1 if back is None else 2} time" in found.message
    assert "stamp 30.1" in found.message or "stamp 30.0" in found.message


def test_a_short_jump_of_a_fast_car_is_not_another_map() -> None:
    """The car drives 0.84 m in a step anyway. Only what the step is too long counts."""
    slow = circle(0.1)
    poses = slow.poses.copy()
    poses[:, :3, 3] *= 14
    fast = jumped(replace(slow, poses=poses), 30.0, 0.6)
    (found,) = check_path(Log("log", (), localization=fast), FIXED)
    assert found.name == "localisation jumps"
    assert not found.spoils
    assert "first by 0.57 m" in found.message
    assert check_path(Log("log", (), localization=jumped(fast, 40.0, 1.5)), FIXED)[0].spoils


def test_a_jump_between_rare_poses_is_named_by_the_odometry() -> None:
    path = jumped(circle(0.5, 0.03), 30.2, 0.6)
    assert names(path) == []
    assert names(path, circle(0.05)) == ["localisation jumps"]


def stamped_late(path: Trajectory, sigma: float, apart: float = 1e-6) -> Trajectory:
    """The path if each pose is stamped after a random time (s). A pose that waits holds up those after it."""
    late = path.stamps + np.abs(np.random.default_rng(1).normal(0, sigma, len(path)))
    order = np.arange(len(path)) * apart
    return replace(path, stamps=np.maximum.accumulate(late - order) + order)


@pytest.mark.parametrize("every", [0.02, 0.05])
def test_poses_that_are_stamped_when_they_arrive_do_not_jump(every: float) -> None:
    """Poses that come together have hardly any time between them, so their speeds mean nothing."""
    path = stamped_late(circle(every), every)
    assert (np.diff(path.stamps) < 0.01 * every).sum() > 30
    assert names(None, path) == names(path) == []
    assert find_jumps(Log("log", (), localization=path), FIXED) is None
    moved = circle(every)
    for at in (30.01, 32.01, 33.01, 34.01):  # One of the poses may wait for so long that it counts as a gap.
        moved = jumped(moved, at, 0.6)
    moved = stamped_late(moved, every)
    assert names(None, moved) == ["odometry jumps"]
    assert names(moved) == ["localisation jumps"]


def test_a_car_whose_poses_are_stamped_when_they_arrive_does_not_jump() -> None:
    """Each of its steps is longer than the least jump of a slow robot."""
    path = circle(0.05)
    poses = path.poses.copy()
    poses[:, :3, 3] *= 15.0  # 9 m/s
    car = replace(path, poses=poses)
    assert np.median(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)) > 0.4
    late = stamped_late(car, 0.02, 1e-7)
    assert names(None, late) == names(late) == []
    assert names(None, stamped_late(jumped(car, 30.01, 5.0), 0.02, 1e-7)) == ["odometry jumps"]


@pytest.mark.parametrize(
    ("gap", "restarts", "said"), [(4.0, True, ["odometry restarts"]), (4.0, False, []), (0.0, False, [])]
)
def test_odometry_that_restarts_in_a_gap_is_named(gap: float, restarts: bool, said: list[str]) -> None:
    path = circle(0.1)
    keep = (path.stamps < 28.0) | (path.stamps >= 28.0 + gap)
    path = replace(path, stamps=path.stamps[keep], poses=path.poses[keep])
    if restarts:
        after = path.stamps > 28.0
        path = replace(path, poses=np.where(after[:, None, None], inverse(path.poses[after][:1]) @ path.poses, path.poses))
    assert names(None, path) == said
    assert names(circle(0.1), path) == []  # In fixed mode with a localisation, the odometry is not used.
    both = Log("log", (), localization=circle(0.1), odometry=path)
    assert [one.name for one in check_path(both, JOINT)] == said


def test_odometry_near_zero_before_a_gap_has_not_restarted() -> None:
    poses = lift_se2(np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [2.0, 1.0, 0.5], [0.0, 0.02, 6.27], [0.2, 0.0, 0.0]]))
    assert counts_from_zero(poses[:-1], poses[1:]).tolist() == [False, False, True, False]


def test_an_arm_that_moves_its_camera_does_not_freeze_the_base() -> None:
    """The base stands, and the boxes move. With the poses of the camera on the base, this is right."""
    log = simulate(preset("rooms"), 0)
    path = log.robot_path
    assert path is not None
    still = replace(path, poses=np.broadcast_to(path.poses[0], path.poses.shape).copy())
    standing = replace(log, localization=still, odometry=None)
    assert [one.name for one in check_path(standing, FIXED)] == ["localisation frozen"]
    moved = tuple(replace(one, mount=path) for one in standing.cameras)
    assert check_path(replace(standing, cameras=moved), FIXED) == []


def test_a_jump_of_odometry_that_is_not_used_spoils_nothing() -> None:
    """A slip between two poses of the localisation is none of its jumps."""
    both = Log("log", (), localization=circle(0.5, 0.03), odometry=jumped(circle(0.05), 30.2, 0.6))
    fixed, joint = check_path(both, FIXED), check_path(both, JOINT)
    assert [one.name for one in fixed] == [one.name for one in joint] == ["odometry jumps"]
    assert not fixed[0].spoils
    assert joint[0].spoils
    slow = Log("log", (), localization=circle(0.5, 0.03), odometry=jumped(circle(0.5), 30.2, 0.6))
    assert check_path(slow, FIXED) == []


def ring(scale: float = 1.0, noise: float = 0.0) -> Trajectory:
    """Three minutes at 0.6 m/s along a circle with a radius of 8 m. noise: of places, m."""
    stamps = np.arange(0.0, 180.0, 0.2)
    angle = 0.6 / 8.0 * stamps
    places = 8.0 * scale * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    places = places + np.random.default_rng(0).normal(0, noise, places.shape)
    return Trajectory(stamps, lift_se2(np.column_stack([places, angle])))


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize(("scale", "said"), [(1.0, []), (1.05, []), (1.3, ["scales differ"]), (0.5, ["scales differ"])])
def test_noisy_places_have_no_other_scale(scale: float, said: list[str], noise: float) -> None:
    """With noise of half a metre, as of satellite positioning, distances of a second are 30 % too long."""
    assert [name for name in names(ring(scale, noise), ring()) if name == "scales differ"] == said
