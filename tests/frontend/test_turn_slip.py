"""Odometry that is too long in curves: what the correction takes out, and what it leaves alone."""

import numpy as np
import pytest
from added_errors import add_shared_errors
from numpy.testing import assert_allclose

from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory, travel
from objslam.core.types import Log
from objslam.frontend.corrected_odometry import OdometryCorrection, corrected_odometry

SLIP = {"odometry.turn_slip": 0.08}


def driven(rate, turn_rate, speed):
    """A path at a number of poses per second. turn_rate, speed: functions of the time, in rad/s and m/s."""
    stamps = np.arange(0, 120, 1 / rate)
    middle = (stamps[1:] + stamps[:-1]) / 2
    yaw = np.append(0.0, np.cumsum(turn_rate(middle)) / rate)
    way, along = speed(middle) / rate, (yaw[1:] + yaw[:-1]) / 2
    x, y = (np.append(0.0, np.cumsum(way * side(along))) for side in (np.cos, np.sin))
    return Trajectory(stamps, lift_se2(np.stack([x, y, yaw], axis=1)))


def apart(one, other):
    return float(np.linalg.norm(one.poses[:, :3, 3] - other.poses[:, :3, 3], axis=1).max())


@pytest.mark.parametrize("rate", [5, 50])
@pytest.mark.parametrize("slip", [0.08, -0.05])
def test_slip_in_curves_is_taken_out_at_any_rate(rate, slip):
    """Straight parts and curves follow each other. Where they meet, the curvature is a mean over half a second."""
    true = driven(rate, lambda t: 0.4 * (t % 20 > 12), lambda t: 0.3 + 0 * t)
    said = add_shared_errors(Log("log", (), true), {"odometry.turn_slip": slip}).odometry
    found = corrected_odometry(said, {"odometry.turn_slip": slip})
    assert apart(said, true) > 0.09
    assert apart(found, true) < 0.05 * apart(said, true)
    assert_allclose(found.poses[:, :3, :3], said.poses[:, :3, :3], atol=1e-12)  # A slip turns nothing.


def test_a_step_never_goes_back_and_a_turn_on_the_spot_moves_nothing():
    spot = driven(20, lambda t: 0.5 + 0 * t, lambda t: 0 * t)
    assert_allclose(corrected_odometry(spot, SLIP).poses, spot.poses, atol=1e-12)
    sharp = driven(20, lambda t: 0.5 + 0 * t, lambda t: 0.02 + 0 * t)  # A radius of 4 cm: all of the way is slip.
    assert_allclose(corrected_odometry(sharp, SLIP).poses[:, :3, 3], 0, atol=1e-12)


def test_jitter_of_the_heading_is_no_curve():
    """A gyroscope at 100 Hz that jitters by a third of a degree turns 25 rad in all on a straight way, to and fro."""
    path = driven(100, lambda t: 0 * t, lambda t: 0.5 + 0 * t)
    jitter = np.random.default_rng(0).normal(0, 0.005, len(path))
    noisy = Trajectory(path.stamps, path.poses @ lift_se2(np.stack([0 * jitter, 0 * jitter, jitter], axis=1)))
    assert np.abs(np.diff(jitter)).sum() > 25
    lost = 1 - np.linalg.norm(np.diff(corrected_odometry(noisy, SLIP).poses[:, :3, 3], axis=0), axis=1).sum() / 60
    assert lost < 0.005


def test_poses_that_were_left_out_keep_their_curves():
    """Half of the poses are left out, at random. The curvature comes from what was travelled between the others."""
    said = driven(20, lambda t: 0.4 * (t % 20 > 12), lambda t: 0.3 + 0 * t)
    keep = np.sort(np.append(0, 1 + np.random.default_rng(1).choice(len(said) - 1, len(said) // 2, replace=False)))
    total = np.cumsum(np.vstack([np.zeros(3), travel(said.poses)[-len(said) + 1 :]]), axis=0)[keep]
    kept = Trajectory(said.stamps[keep], said.poses[keep], np.vstack([np.zeros(3), np.diff(total, axis=0)]))
    whole, part = corrected_odometry(said, SLIP), corrected_odometry(kept, SLIP)
    assert apart(Trajectory(kept.stamps, whole.poses[keep]), part) < 0.05 * apart(said, whole)
    assert_allclose(part.travel[:, 0].sum(), travel(whole.poses)[:, 0].sum(), rtol=0.01)


def test_a_session_corrects_pose_by_pose_nearly_the_same():
    """A session does not know the curve to come, so it corrects each curve a quarter of a second later."""
    said = driven(20, lambda t: 0.4 * (t % 20 > 12), lambda t: 0.3 + 0 * t)
    whole, live = corrected_odometry(said, SLIP), OdometryCorrection(SLIP)
    poses = np.stack([live.correct(float(t), pose) for t, pose in zip(said.stamps, said.poses, strict=True)])
    assert apart(Trajectory(said.stamps, poses), whole) < 0.1 * apart(said, whole)
