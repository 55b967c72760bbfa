"""Odometry that is too long sideways: which robots have this error, what the correction takes out, and what a run finds."""

import numpy as np
import pytest
from added_errors import add_shared_errors
from bench_robots import robot
from numpy.testing import assert_allclose

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory, travel
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.corrected_odometry import CorrectablePath, corrected_odometry
from objslam.frontend.known_errors import possible
from objslam.mapping import pipeline

NAME = "odometry.lateral_scale"


def driven(sideways, lever=(0.0, 0.0), axes=0.0, rate=20):
    """A path with curves. sideways: m/s at times t. lever: where base is, m. axes: by how much base is turned, rad."""
    stamps = np.arange(0, 120, 1 / rate)
    middle = (stamps[1:] + stamps[:-1]) / 2
    yaw = np.append(0.0, np.cumsum(0.8 * (middle % 20 > 14) * np.sin(middle)) / rate)
    left, along = sideways(middle) / rate, (yaw[1:] + yaw[:-1]) / 2
    x, y = (
        np.append(0.0, np.cumsum(0.3 / rate * a + left * b))
        for a, b in ((np.cos(along), -np.sin(along)), (np.sin(along), np.cos(along)))
    )
    return Trajectory(stamps, lift_se2(np.stack([x, y, yaw], axis=1)) @ lift_se2(np.array([*lever, axes])))


def to_and_fro(t):
    return 0.2 * np.sin(t)


def jitter(path, size):
    return Trajectory(path.stamps, path.poses @ lift_se2(np.random.default_rng(0).normal(0, size, (len(path), 3))))


@pytest.mark.parametrize("lever", [(0.0, 0.0), (0.4, 0.1)])
@pytest.mark.parametrize("axes", [0.0, 0.7, np.pi / 2])
def test_two_wheels_never_drive_sideways_wherever_base_is(lever, axes):
    for rate in (2, 20):
        assert not CorrectablePath(driven(lambda t: 0 * t, lever, axes, rate)).drives_sideways
        assert CorrectablePath(driven(to_and_fro, lever, axes, rate)).drives_sideways


def test_jitter_of_poses_is_not_driving_sideways():
    assert not CorrectablePath(jitter(driven(lambda t: 0 * t), 0.003)).drives_sideways


def test_a_robot_that_stands_or_has_one_pose_does_not_drive_sideways():
    for count in (1, 2, 50):
        assert not CorrectablePath(Trajectory(np.arange(float(count)), np.tile(np.eye(4), (count, 1, 1)))).drives_sideways


def test_only_a_robot_that_drives_sideways_in_the_plane_has_the_error():
    settings = load_settings(None, ("mode=joint",))
    path = driven(to_and_fro)
    tilted = Trajectory(
        path.stamps,
        path.poses
        @ make_pose(rotation_from_vector(np.full((len(path), 3), 0.01) * np.sin(path.stamps)[:, None]), np.zeros(3)),
    )
    for odometry, has in ((path, True), (driven(lambda t: 0 * t), False), (tilted, False)):
        assert (NAME in possible(Log("log", (), odometry), settings)) == has
    assert NAME not in possible(Log("log", (), path), load_settings(None, ("mode=joint", "calibration.lateral_scale=0")))
    assert NAME not in possible(Log("log", (), path), load_settings(None, ("mode=fixed",)))


@pytest.mark.parametrize("share", [-0.15, 0.1])
def test_the_error_is_taken_out(share):
    true = driven(to_and_fro)
    said = add_shared_errors(Log("log", (), true), {NAME: share}).odometry
    found = corrected_odometry(said, {NAME: share})
    assert np.abs(said.poses - true.poses).max() > 0.02
    assert_allclose(found.poses, true.poses, atol=1e-9)


def test_two_wheels_are_as_they_were():
    path = driven(lambda t: 0 * t)
    assert_allclose(corrected_odometry(path, {NAME: -0.2}).poses, path.poses, atol=1e-9)


def test_the_way_between_poses_that_were_left_out_is_corrected():
    said = driven(lambda t: 0.3 + 0 * t)
    total = np.cumsum(np.vstack([np.zeros(3), travel(said.poses)[-len(said) + 1 :]]), axis=0)[::3]
    kept = Trajectory(said.stamps[::3], said.poses[::3], np.vstack([np.zeros(3), np.diff(total, axis=0)]))
    whole, part = (corrected_odometry(path, {NAME: -0.2}) for path in (said, kept))
    assert_allclose(part.poses[-1], whole.poses[::3][-1], atol=2e-3)
    assert_allclose(part.travel[:, 0].sum(), travel(whole.poses)[:, 0].sum(), rtol=0.01)


def test_a_run_finds_the_error_and_its_map_is_honest():
    """The simulated robot goes sideways 21 % less than its wheels say. Without this error, its objects are off by 0.5 m."""
    log, true = robot(2, "mecanum")
    alone = ("checks.use=false", "bodies.use=false", "association.method=by_label")
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false", *alone)), Ledger())
    at = result.calibration.names.index(NAME)
    assert abs(result.calibration.values[at] - true[NAME]) < 3 * result.calibration.sigma[at] < 0.06
    found = evaluate(result.map, log.truth, align="se2", radius=3.0).to_dict()
    assert found["matched"] == len(log.truth.objects) == 14
    assert found["position_rmse"] < 0.15
    assert found["inside_95_3d"] > 0.85
