"""The motions and ties of a slow odometry: against the dense covariance of a path that its poses hold."""

from dataclasses import replace

import numpy as np
import pytest
from drives import drive_of
from numpy.testing import assert_allclose

from objslam.config import Odometry, Settings, load_settings
from objslam.core.geometry import exp_se3, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Keyframes
from objslam.graph.assembly import Measurements
from objslam.graph.factors.odometry import motions
from objslam.graph.factors.odometry_motions import OdometryMotions, find_ties
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import make_values
from objslam.simulation import preset, simulate

YAW, X, Y = 2, 3, 4  # Axes of a twist.
ALONG = 1e-4  # m^2 of the odometry's noise in a step


def keyframes_at(step, wander=4e-3):
    """Keyframes of a robot that drives along x, one metre a step of its odometry, and may be `wander` (m^2) off along x."""
    step = np.asarray(step, dtype=float)
    n = len(step)
    odom_T_base = lift_se2(np.column_stack([step, np.zeros((n, 2))]))
    drift, variance = np.zeros((n, 6, 6)), np.zeros((n, 6))
    drift[:, X, X], variance[:, X] = ALONG * step, wander
    return Keyframes(
        stamps=step,
        camera=np.zeros(n, dtype=np.int64),
        frame=np.arange(n),
        base_T_camera=np.tile(np.eye(4), (n, 1, 1)),
        map_T_base=odom_T_base,
        odom_T_base=odom_T_base,
        drift=drift,
        step=step,
        wander=variance,
    )


def information(of: OdometryMotions, count):
    """The information (count, count) about the places along x of keyframes."""
    jacobian = np.zeros((len(of), count))
    jacobian[np.arange(len(of)), of.before], jacobian[np.arange(len(of)), of.after] = -1, 1
    return jacobian.T @ (jacobian / of.covariance[:, X, X][:, None])


@pytest.mark.parametrize("wander", [1e-5, 1e-4, 4e-3, 1.0])
def test_motions_and_ties_together_are_exact(wander):
    """Five keyframes a step, one at each pose of the odometry."""
    keyframes, settings = keyframes_at(np.arange(16) / 5, wander), Settings()
    ties = np.array([[0, 5], [5, 10], [10, 15]])
    found = information(OdometryMotions.of(keyframes, settings, ties), 16)
    one = (ALONG / 5 + settings.odometry.floor_xy**2 + wander / 5) * np.eye(5) - wander / 25 * np.ones((5, 5))
    jacobian = np.diff(np.eye(16), axis=0)
    right = jacobian.T @ np.linalg.inv(np.kron(np.eye(3), one)) @ jacobian
    assert_allclose(found, right, rtol=1e-6, atol=1e-5 * right.max())


def test_ties_are_between_the_keyframes_nearest_to_poses_of_a_slow_odometry():
    step = np.arange(2, 34) / 10
    ties = find_ties(keyframes_at(step), Settings())
    assert_allclose(step[ties], [[0.2, 1.0], [1.0, 2.0], [2.0, 3.0]])


@pytest.mark.parametrize("count", [16, 40])
def test_a_tie_never_claims_more_than_is_true(count):
    """Keyframes beside the poses of the odometry: no direction is more certain than by the dense covariance."""
    step = 0.06 + np.arange(count) / 9.3
    keyframes, settings, wander = keyframes_at(step), Settings(), 4e-3
    found = information(OdometryMotions.of(keyframes, settings, find_ties(keyframes, settings)), count)
    share, same = step % 1, np.floor(step)[:, None] == np.floor(step)
    bridge = wander * np.where(same, np.minimum.outer(share, share) * (1 - np.maximum.outer(share, share)), 0.0)
    jacobian = np.diff(np.eye(count), axis=0)
    noise = np.diag(ALONG * np.diff(step) + settings.odometry.floor_xy**2) + jacobian @ bridge @ jacobian.T
    right = jacobian.T @ np.linalg.inv(noise) @ jacobian
    at = np.linalg.pinv(found[1:, 1:])  # With the first keyframe held.
    true = np.linalg.pinv(right[1:, 1:])
    ends = np.diag(at) / np.diag(true)
    assert (ends > 0.85).all(), ends
    assert (ends < 2.5).all(), ends


@pytest.mark.parametrize("changes", [{"step": np.arange(20.0)}, {"step": np.arange(60) / 5, "wander": 1e-8}])
def test_fast_or_steady_odometry_has_no_ties(changes):
    keyframes = keyframes_at(**changes)
    assert find_ties(keyframes, Settings()).shape == (0, 2)
    assert find_ties(replace(keyframes, step=None, wander=None), Settings()).shape == (0, 2)


def test_a_motion_between_interpolated_poses_has_the_variance_of_both():
    _, covariance = motions(keyframes_at([0.25, 0.75, 1.75, 4.0, 4.5]), Settings())
    known = ALONG * np.array([0.5, 1.0, 2.25, 0.5]) + Settings().odometry.floor_xy ** 2
    assert_allclose(covariance[:, X, X] - known, 4e-3 * np.array([0.25, 0.375, 0.1875, 0.25]), rtol=1e-9)


def test_an_unknown_heading_at_the_first_keyframe_turns_the_whole_way():
    """Both ends of two metres are in the middle of a step."""
    keyframes = keyframes_at([0.5, 2.5], 0.0)
    keyframes.wander[:, YAW] = 4e-3
    _, covariance = motions(keyframes, Settings())
    of = Settings().odometry
    assert covariance[0, YAW, YAW] - of.floor_yaw**2 == pytest.approx(2 * 1e-3)
    assert covariance[0, Y, Y] - of.floor_xy**2 == pytest.approx(1e-3 * 2**2)
    assert abs(covariance[0, YAW, Y]) == pytest.approx(1e-3 * 2)


def test_only_what_was_measured_is_a_motion():
    keyframes = replace(keyframes_at(np.arange(12) / 5), localized_every=1.0, stretch=np.repeat([0, -1, 1], [6, 1, 5]))
    ties = find_ties(keyframes, Settings())
    assert ties.tolist() == [[0, 5]]
    found = OdometryMotions.of(keyframes, Settings(), ties)
    assert found.before.tolist() == [0, 1, 2, 3, 4, 7, 8, 9, 10, 0]
    assert found.after.tolist() == [1, 2, 3, 4, 5, 8, 9, 10, 11, 5]


def test_the_rows_of_ties_are_those_of_gtsam():
    settings = load_settings(None, ("mode=joint",))
    log = simulate(preset("demo", frames=200, objects=8, classes=8, localization=None, odometry=Odometry()), 3)
    slow = Trajectory(log.odometry.stamps[::7], log.odometry.poses[::7])
    made = drive_of(replace(log, odometry=slow), load_settings(None, ("mode=joint", "poses.max_gap=10")))
    measured = Measurements.of(made.keyframes, made.rays, settings)
    assert len(measured.motions) > len(made.keyframes) + 10
    rng = np.random.default_rng(0)
    poses = made.map_T_base @ made.keyframes.base_T_camera
    poses = poses @ exp_se3(rng.normal(scale=0.02, size=(len(poses), 6)))
    used, landmarks = made.right(), np.arange(len(made.points))
    graph = build_graph(measured.factors(made.association.object, np.flatnonzero(used), landmarks, made.points))
    rows = JointGraph.of(measured, made.association, used, made.points).rows(poses, made.points)
    values = make_values(poses, made.points, landmarks)
    assert rows.cost == pytest.approx(graph.error(values), rel=2e-3)
    gradient = graph.linearize(values).gradientAtZero()
    mine = rows.jacobian.T @ rows.residual
    assert_allclose(mine[-6:], gradient.at(max(values.keys())), rtol=1e-2, atol=1e-3 * np.abs(mine).max())
