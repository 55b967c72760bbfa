"""Jumps of a localisation: found where they are, not found where none are, taken out, and in the error of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.geometry import lift_se2
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.localization.localization_jumps import Jumps, find_jumps

SETTINGS = load_settings(None, ())


def drive(every: float, noise: float = 0.0, seed: int = 0, speed: float = 0.6) -> Trajectory:
    """One minute along a circle, with stops of 5 s each 20 s. every: s between poses. noise: of places, m."""
    stamps, fine = np.arange(0.0, 60.0, every), np.arange(0.0, 60.0, 0.01)
    angle = np.interp(stamps, fine, np.cumsum(np.where(fine % 20 < 15, speed / 1.5, 0.0)) * 0.01)
    rng = np.random.default_rng(seed)
    places = 1.5 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) + rng.normal(0, noise, (len(stamps), 2))
    return Trajectory(stamps, lift_se2(np.column_stack([places, angle + rng.normal(0, noise / 5, len(stamps))])))


def jumped(path: Trajectory, after: float, move: tuple[float, float], turn: float = 0.0) -> Trajectory:
    """The path, aside by `move` (m) and turned by `turn` (rad) after a stamp."""
    poses, late = path.poses.copy(), path.stamps > after
    poses[late, :2, 3] += move
    poses[late, :3, :3] = rotation_from_vector(np.array([0.0, 0.0, turn])) @ poses[late, :3, :3]
    return replace(path, poses=poses)


def found(localization: Trajectory, odometry: Trajectory | None = None) -> Jumps | None:
    return find_jumps(Log("log", (), localization=localization, odometry=odometry), SETTINGS)


@pytest.mark.parametrize(
    ("every", "noise", "speed"),
    [(0.1, 0.0, 0.6), (0.1, 0.02, 0.6), (0.05, 0.05, 0.6), (0.02, 0.01, 3.0), (0.5, 0.03, 0.6), (1.0, 0.0, 0.6)],
)
def test_a_drive_with_stops_has_no_jumps(every: float, noise: float, speed: float) -> None:
    for seed in range(10):
        path = drive(every, noise, seed, speed)
        assert found(path) is None
        assert found(path, drive(0.05, 0.0, 0, speed)) is None


def test_a_camera_that_a_hand_swings_has_no_jump() -> None:
    """At 10 Hz, 5 cm a step, 23 cm in one, and 3 cm in the next: a hand does this, and a robot on a floor does not."""
    path = drive(0.1)
    way = np.full(len(path), 0.05)
    way[300:302] = 0.23, 0.03
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    poses[:, 0, 3] = np.cumsum(way)
    floor = replace(path, poses=poses.copy())
    poses[:, 2, 3] = 0.1 * np.sin(path.stamps)
    assert found(replace(path, poses=poses)) is None
    assert found(floor) is not None


def test_a_localisation_that_repeats_each_pose_has_no_jumps() -> None:
    path, slow = drive(0.1), np.repeat(np.arange(0, 600, 10), 10)
    assert found(replace(path, poses=path.poses[slow])) is None
    assert found(replace(path, poses=path.poses[slow]), drive(0.05)) is None


@pytest.mark.parametrize("wheels", [False, True])
def test_a_jump_there_and_back_is_measured_and_taken_out(wheels: bool) -> None:
    right = drive(0.1, 0.008)
    path = jumped(jumped(right, 25.0, (0.25, -0.1), 0.06), 45.0, (-0.25, 0.1), -0.06)
    log = Log("log", (), localization=path, odometry=drive(0.05) if wheels else None)
    jumps = find_jumps(log, SETTINGS)
    assert jumps is not None
    np.testing.assert_allclose(jumps.stamps, [25.1, 45.1], atol=0.11)
    np.testing.assert_allclose(jumps.moves, [[0.25, -0.1, 0], [-0.25, 0.1, 0]], atol=0.06)
    np.testing.assert_allclose(jumps.turns[:, 2], [0.06, -0.06], atol=0.012)
    np.testing.assert_allclose(jumps.shares, [25 / 60, 20 / 60, 15 / 60], atol=0.01)
    after = jumps.taken_out(path)
    off = after.poses[:, :3, 3] - right.poses[:, :3, 3]
    assert np.ptp(off, axis=0).max() < 0.1  # Before, 0.25 m.
    np.testing.assert_allclose(after.poses[:, :3, 3].mean(axis=0), path.poses[:, :3, 3].mean(axis=0), atol=1e-3)


def corrected_often(path: Trajectory, seed: int, every: float = 4.0, size: float = 0.07) -> Trajectory:
    """The path with the error of a particle filter: a new place error (m) about every 4 s, and the odometry between."""
    rng = np.random.default_rng(seed)
    number = np.searchsorted(np.cumsum(rng.uniform(0.5, 1.5, 60) * every), path.stamps)
    poses = path.poses.copy()
    poses[:, :2, 3] += rng.normal(0, size, (61, 2))[number]
    return replace(path, poses=poses)


@pytest.mark.parametrize("wheels", [False, True])
def test_the_largest_of_many_corrections_is_no_jump(wheels: bool) -> None:
    """The corrections have 0.07 m on each axis before and after, so some of the 15 are longer than 0.15 m."""
    odometry = drive(0.05) if wheels else None
    for seed in range(10):
        path = drive(0.1, 0.003, seed)
        assert found(corrected_often(path, seed), odometry) is None
        jumps = found(jumped(corrected_often(path, seed, size=0.03), 30.0, (0.5, -0.4)), odometry)
        assert jumps is not None
        np.testing.assert_allclose(jumps.stamps, [30.1], atol=0.11)


def test_only_the_odometry_shows_jumps_between_rare_poses() -> None:
    path = jumped(drive(0.5, 0.01), 30.2, (0.3, 0.2))
    assert found(path) is None
    jumps = found(path, drive(0.05))
    assert jumps is not None
    assert jumps.stamps.tolist() == [30.5]


def test_a_slip_of_the_odometry_is_no_jump() -> None:
    assert found(drive(0.1, 0.01), jumped(drive(0.05), 30.2, (0.4, 0.0))) is None


def test_a_long_jump_and_the_will_of_the_user_stay() -> None:
    assert found(jumped(drive(0.1, 0.01), 30.0, (1.5, 0.0))) is None
    log = Log("log", (), localization=jumped(drive(0.1, 0.01), 30.0, (0.5, 0.0)))
    keep = load_settings(None, ("poses.jumps=keep",))
    assert find_jumps(log, keep) is None


def test_the_error_of_a_map_is_that_of_the_draws() -> None:
    """Short parts of the path are right less often, and jumps are known to their noise only."""
    rng = np.random.default_rng(0)
    jumps = Jumps(
        np.array([30.0, 50.0]),
        np.array([[0.3, 0.1, 0.0], [-0.1, 0.2, 0.0]]),
        np.array([[0.0, 0.0, 0.03], [0.0, 0.0, -0.01]]),
        np.array([[0.02, 0.03, 0.0], [0.0, 0.0, 0.004]]),
        np.array([0.5, 0.3, 0.2]),
    )
    stamps, owner = np.linspace(0, 60, 40), np.arange(40) % 2
    origins, positions = rng.uniform(-1, 1, (40, 3)), rng.uniform(2, 4, (2, 3))
    factor = jumps.spread(stamps, origins, owner, positions).reshape(6, -1)
    centre = np.stack([origins[owner == j].mean(axis=0) for j in (0, 1)])
    place = np.concatenate([[[0, 0, 0]], np.cumsum(jumps.moves, axis=0)])
    turn = np.concatenate([[0], np.cumsum(jumps.turns[:, 2])])
    late = np.stack([[(stamps[owner == j] >= at).mean() for at in (30.0, 50.0)] for j in (0, 1)])
    likely = np.sqrt([0.5, 0.3, 0.2]) / np.sqrt([0.5, 0.3, 0.2]).sum()
    draws = []
    for right in rng.choice(3, 6_000, p=likely):
        move = place[right] - jumps.shares @ place
        angle = turn[right] - jumps.shares @ turn
        off = move + angle * np.cross([0, 0, 1], positions - centre)
        for k, after in enumerate((0.5, 0.2)):
            error, bend = rng.normal(0, jumps.noise[0]), rng.normal(0, jumps.noise[1])
            off = off + (late[:, k, None] - after) * (error + np.cross(bend, positions - centre))
        draws.append(off.ravel())
    expected = np.mean([np.outer(one, one) for one in draws], axis=0)
    np.testing.assert_allclose(factor @ factor.T, expected, atol=0.06 * np.abs(expected).max())
