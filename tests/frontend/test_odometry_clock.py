"""The clock of the odometry against the localisation: found where it is wrong, and left alone where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.localization.odometry_clock import OdometryClock, at_one_clock, clock_of_odometry

SECONDS = 300.0


def driven(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,), s, and x, y, yaw (n, 3) of a robot that turns on the spot and drives, in turn."""
    rng, at = np.random.default_rng(seed), np.arange(0.0, SECONDS, 0.01)
    speed, turn, now = np.zeros(len(at)), np.zeros(len(at)), 0.0
    while now < SECONDS:
        for length, v, w in ((rng.uniform(1, 4), 0.0, 0.6 * rng.choice([-1, 1])), (rng.uniform(2, 6), 0.3, 0.1)):
            on = (at >= now) & (at < now + length)
            speed[on], turn[on], now = v, w, now + length
    fades = np.exp(-np.arange(60) / 15)  # Wheels follow a command within 0.15 s.
    speed, turn = (np.convolve(one, fades / fades.sum())[: len(at)] for one in (speed, turn))
    yaw = np.cumsum(turn) * 0.01
    return at, np.column_stack([np.cumsum(speed * np.cos(yaw)) * 0.01, np.cumsum(speed * np.sin(yaw)) * 0.01, yaw])


def odometry(seed: int, offset: float = 0.0, every: float = 0.05) -> Trajectory:
    """The odometry of `driven`, which slips, with stamps that lack `offset`, s."""
    rng, (at, path) = np.random.default_rng(seed + 100), driven(seed)
    poses = lift_se2(path[:: round(every / 0.01)])
    step = inverse(poses[:-1]) @ poses[1:]
    turn = np.arctan2(step[:, 1, 0], step[:, 0, 0]) * 0.97 + 0.003 * every
    way = step[:, 0, 3] * 1.04
    turn += np.abs(turn) ** 0.5 * 0.01 * rng.normal(size=len(turn))
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    middle = yaw[:-1] + turn / 2
    place = np.concatenate(
        [np.zeros((1, 2)), np.cumsum(way[:, None] * np.column_stack([np.cos(middle), np.sin(middle)]), axis=0)]
    )
    return Trajectory(at[:: round(every / 0.01)] - offset, lift_se2(np.column_stack([place, yaw])))


def localization(seed: int, every: float = 0.1, noise: float = 0.01) -> Trajectory:
    """Noisy poses of `driven`, in another frame. noise: m, and in heading half of it in rad."""
    rng, (at, path) = np.random.default_rng(seed + 200), driven(seed)
    poses = path[:: round(every / 0.01)] + rng.normal(size=(len(path[:: round(every / 0.01)]), 3)) * [
        noise,
        noise,
        noise / 2,
    ]
    return Trajectory(at[:: round(every / 0.01)], lift_se2(np.array([3.0, -1.0, 2.0])) @ lift_se2(poses))


def found(wheels: Trajectory, poses: Trajectory) -> OdometryClock | None:
    return clock_of_odometry(wheels, poses, 0.5, 1.1)


@pytest.mark.parametrize("offset", [-0.3, -0.1, -0.05, 0.05, 0.1, 0.3])
def test_an_offset_is_found(offset: float) -> None:
    for seed in range(3):
        clock = found(odometry(seed, offset), localization(seed))
        assert clock is not None
        assert clock.sigma < 0.01
        assert abs(clock.offset - offset) < 3 * clock.sigma


@pytest.mark.parametrize("every", [0.05, 0.1, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_paths_of_one_clock_are_left_alone(every: float, noise: float) -> None:
    for seed in range(3):
        assert found(odometry(seed), localization(seed, every, noise)) is None
        assert found(odometry(seed, every=0.2), localization(seed, every, noise)) is None


def test_jumps_and_gaps_of_a_localisation_do_not_hide_an_offset() -> None:
    path = localization(0)
    poses = path.poses.copy()
    for at in (40.0, 120.0, 230.0):
        poses[path.stamps > at] = lift_se2(np.array([0.5, -0.4, 0.6])) @ poses[path.stamps > at]
    kept = ((path.stamps < 60) | (path.stamps > 90)) & ((path.stamps < 150) | (path.stamps > 180))
    clock = found(odometry(0, 0.32), Trajectory(path.stamps[kept], poses[kept]))
    assert clock is not None
    assert abs(clock.offset - 0.32) < max(3 * clock.sigma, 0.01)


def test_a_gap_of_the_odometry_does_not_hide_an_offset() -> None:
    path = odometry(0, -0.2)
    kept = (path.stamps < 100) | (path.stamps > 110)
    clock = found(Trajectory(path.stamps[kept], path.poses[kept]), localization(0))
    assert clock is not None
    assert abs(clock.offset + 0.2) < 3 * clock.sigma


def test_rare_poses_show_an_offset_of_tenths_of_a_second() -> None:
    for seed in range(3):
        clock = found(odometry(seed, 0.3), localization(seed, 2.0))
        assert clock is None or abs(clock.offset - 0.3) < 3 * clock.sigma
    assert found(odometry(0, 0.3), localization(0, 2.0)) is not None


def test_a_filter_that_follows_the_odometry_has_its_clock() -> None:
    """Its corrections come after the errors that they correct, so they look late."""
    for seed in range(3):
        wheels, (at, path) = odometry(seed), driven(seed)
        times = np.arange(0.0, SECONDS - 1, 0.8)
        said = lift_se2(path[np.searchsorted(at, times)])
        map_T_odom = said @ inverse(interpolate(wheels.stamps, wheels.poses, times, np.inf)[0])
        last = np.maximum(np.searchsorted(times, wheels.stamps, side="right") - 1, 0)
        assert found(wheels, Trajectory(wheels.stamps, map_T_odom[last] @ wheels.poses)) is None


def test_poses_that_are_repeated_until_the_next_one_are_not_late() -> None:
    path = localization(0, 0.5)
    stamps = np.arange(0.0, SECONDS - 1, 0.1)
    held = np.searchsorted(path.stamps, stamps + 1e-9, side="right") - 1
    assert found(odometry(0), Trajectory(stamps, path.poses[held])) is None


def test_a_robot_that_drives_evenly_shows_no_clock() -> None:
    stamps = np.arange(0.0, SECONDS, 0.1)
    line = lift_se2(np.column_stack([0.3 * stamps, 0 * stamps, 0 * stamps]))
    circle = lift_se2(np.column_stack([np.sin(0.2 * stamps), 1 - np.cos(0.2 * stamps), 0.2 * stamps]))
    rng = np.random.default_rng(0)
    noisy = lift_se2(rng.normal(size=(len(stamps), 3)) * [0.01, 0.01, 0.005])
    for poses in (line, circle):
        assert found(Trajectory(stamps - 0.3, poses), Trajectory(stamps, poses @ noisy)) is None
    still = np.broadcast_to(np.eye(4), line.shape).copy()
    assert found(Trajectory(stamps, still), Trajectory(stamps, still)) is None
    assert found(Trajectory(stamps, still), Trajectory(stamps, still @ noisy)) is None


@pytest.mark.parametrize("count", [0, 1, 2, 3, 30])
def test_short_paths_show_no_clock(count: int) -> None:
    wheels, path = odometry(0, 0.3), localization(0)
    assert found(Trajectory(wheels.stamps[:count], wheels.poses[:count]), path) is None
    assert found(wheels, Trajectory(path.stamps[:count], path.poses[:count])) is None


def test_the_odometry_is_corrected_and_the_localisation_is_not() -> None:
    log = Log("log", (), odometry=odometry(0, 0.3), localization=localization(0))
    assert log.odometry is not None
    ledger = Ledger()
    corrected, clock = at_one_clock(log, load_settings(None, ()), ledger)
    assert clock is not None
    assert corrected.odometry is not None
    np.testing.assert_allclose(corrected.odometry.stamps - log.odometry.stamps, clock.offset)
    assert corrected.odometry.poses is log.odometry.poses
    assert corrected.localization is log.localization
    (line,) = ledger.warnings
    assert line.startswith("the odometry's stamps are 0.30 s early against those of the localisation (+- 0.01 s): corrected")


@pytest.mark.parametrize("setting", ["calibration.odometry_clock=false", "calibration.use=false"])
def test_a_setting_keeps_the_stamps(setting: str) -> None:
    log, ledger = Log("log", (), odometry=odometry(0, 0.3), localization=localization(0)), Ledger()
    kept, clock = at_one_clock(log, load_settings(None, (setting,)), ledger)
    assert (kept, clock, ledger.warnings) == (log, None, [])
    for part in ("odometry", "localization"):
        assert at_one_clock(replace(log, **{part: None}), load_settings(None, ()), ledger)[1] is None
