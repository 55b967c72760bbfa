"""How far a path is from the interpolated one: against simulated paths whose true positions inside the steps are known."""

import numpy as np
import pytest
from scipy.signal import lfilter

from objslam.config import Odometry
from objslam.core.geometry import interpolate, inverse, lift_se2, log_se3
from objslam.core.trajectory import Trajectory
from objslam.frontend.odometry_bridge import OdometryBridge

FINE = 20  # True poses in a step.


def driven(forward, turning, seconds):
    """The true path (n + 1, 4, 4) of speeds (n,) m/s and turn rates (n,) rad/s, each held for `seconds`."""
    yaw = np.append(0.0, np.cumsum(turning * seconds))
    ahead = forward * seconds
    middle = (yaw[1:] + yaw[:-1]) / 2
    x, y = (np.append(0.0, np.cumsum(ahead * way(middle))) for way in (np.cos, np.sin))
    return lift_se2(np.column_stack([x, y, yaw]))


def off(true, step):
    """The squared errors (n, 6) of poses interpolated between every FINE-th one, and the bridge of the odometry."""
    stamps = np.arange(len(true)) * step / FINE
    odometry = Trajectory(stamps[::FINE], true[::FINE])
    found, valid = interpolate(odometry.stamps, odometry.poses, stamps, np.inf)
    assert valid.all()
    return log_se3(inverse(found) @ true) ** 2, OdometryBridge.of(odometry)


def speeds(kind, rng, steps, step):
    """Speeds about 0.5 m/s, and turn rates: white noise, a random walk, or a robot that turns now and then."""
    count, short = steps * FINE, step / FINE
    if kind == "white":
        return 0.5 + 0.1 * rng.normal(size=count) / np.sqrt(short), 0.2 * rng.normal(size=count) / np.sqrt(short)
    if kind == "walk":
        pushes = np.sqrt(short) * rng.normal(size=(2, count)) * [[0.05], [0.1]]
        walks = lfilter([1.0], [1.0, -np.exp(-1 / (20 * FINE))], pushes)  # Over 20 steps, it returns to the mean.
        return 0.5 + walks[0], walks[1]
    parts = rng.integers(2 * FINE, 8 * FINE, count)
    number = np.searchsorted(np.cumsum(parts), np.arange(count), side="right")
    return rng.uniform(0.2, 0.8, count)[number], rng.choice([-0.8, 0.0, 0.0, 0.8], count)[number]


@pytest.mark.parametrize("kind", ["white", "walk", "turns"])
@pytest.mark.parametrize("step", [0.02, 1.0])
def test_the_variance_is_that_of_the_true_path(kind, step):
    """The mean of s (1 - s) over a step is 1/6. The bridge of the robot that turns now and then is that of a random walk."""
    squared, bridge = off(driven(*speeds(kind, np.random.default_rng(3), 2000, step), step / FINE), step)
    ratio = squared[:, [2, 3]].mean(axis=0) / (bridge.wander[:, [2, 3]].mean(axis=0) / 6)
    assert (ratio > 0.7).all(), ratio
    assert (ratio < 1.15).all(), ratio


def test_a_step_in_which_the_velocity_changes_wanders_more():
    forward, turning = np.full(40 * FINE, 0.5), np.zeros(40 * FINE)
    turning[20 * FINE + FINE // 2 :] = 1.0
    _, bridge = off(driven(forward, turning, 1 / FINE), 1.0)
    yaw = bridge.wander[:, 2]
    assert yaw[20] == yaw.max()
    assert yaw[[19, 21]].min() > 3 * yaw[5]
    assert 0 < yaw[5] == yaw[35]


def test_a_steady_robot_is_where_it_is_interpolated():
    _, bridge = off(driven(np.full(400, 0.5), np.full(400, 0.3), 0.05), 1.0)
    np.testing.assert_allclose(bridge.wander, 0.0, atol=1e-20)


def test_fast_odometry_has_next_to_nothing():
    """At 67 Hz, a tenth of the least noise of a motion (`floor_yaw`, `floor_xy`). The robot turns every other second."""
    turning = np.repeat(np.resize([0.0, 0.8, 0.0, -0.8], 60), 67 * FINE)
    turning = np.convolve(
        turning, np.full(20 * FINE, 1 / 20 / FINE), mode="same"
    )  # It takes 0.3 s to begin or to end a turn.
    _, bridge = off(driven(np.full(len(turning), 0.5), turning, 1 / 67 / FINE), 1 / 67)
    floor = np.array([Odometry().floor_yaw, Odometry().floor_xy])
    assert (np.sqrt(bridge.wander.mean(axis=0) / 4)[2:4] < 0.1 * floor).all()


def test_poses_that_are_stamped_late_have_errors_of_the_way_that_the_robot_drives_meanwhile():
    """The poses of 10 ms come in groups, a microsecond apart. The bridge was 1000 times as large."""
    rng, count = np.random.default_rng(5), 6000
    true = driven(np.full(count, 0.5), np.full(count, 0.3), 0.01)
    stamps = np.arange(count + 1) * 0.01
    late = stamps + np.abs(rng.normal(0, 0.02, len(stamps)))
    late = np.maximum.accumulate(late - np.arange(len(late)) * 1e-6) + np.arange(len(late)) * 1e-6
    assert (np.diff(late) < 1e-4).mean() > 0.3
    bridge = OdometryBridge.of(Trajectory(late, true))
    off_late = log_se3(inverse(interpolate(late, true, stamps, np.inf)[0]) @ true)
    spread = off_late[:, [2, 3]].std(axis=0)
    largest = np.sqrt(bridge.wander[:, [2, 3]].max(axis=0)) / 2
    assert (largest < 3 * spread).all(), (largest, spread)
    assert (largest > 0.1 * spread).all(), (largest, spread)


def test_a_gap_of_a_fast_odometry_is_bridged_as_its_neighbours_show():
    """One second is missing at 20 Hz, in which the robot begins to turn."""
    turning = np.where(np.arange(400) < 200, 0.0, 0.8)
    true = driven(np.full(400, 0.5), turning, 0.05)
    stamps, kept = np.arange(401) * 0.05, np.r_[:190, 210:401]
    bridge = OdometryBridge.of(Trajectory(stamps[kept], true[kept]))
    (step,), (variance,) = bridge.at(np.array([10.0]))
    error = abs(log_se3(inverse(interpolate(stamps[kept], true[kept], np.array([10.0]), 2.0)[0]) @ true[200:201])[0, 2])
    assert step == pytest.approx(189 + 11 / 21)
    assert error / 3 < np.sqrt(variance[2] / 4) < 3 * error


def test_stamps_beyond_the_path_are_at_its_ends():
    _, bridge = off(driven(*speeds("turns", np.random.default_rng(5), 10, 1.0), 1 / FINE), 1.0)
    step, variance = bridge.at(np.array([-3.0, 2.25, 10.0, 99.0]))
    np.testing.assert_allclose(step, [0, 2.25, 10, 10])
    np.testing.assert_array_equal(variance, bridge.wander[[0, 2, 9, 9]])
    one = OdometryBridge.of(Trajectory(np.zeros(1), np.eye(4)[None]))
    np.testing.assert_array_equal(one.at(np.array([0.0, 1.0]))[1], np.zeros((2, 6)))
