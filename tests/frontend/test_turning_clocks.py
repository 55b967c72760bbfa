"""The clocks of cameras from turns alone, on simulated drives whose clocks are wrong by a known offset."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from scipy.spatial.transform import Rotation
from turning_drive import drive, errors_of

from objslam.core.geometry import inverse, make_pose
from objslam.core.trajectory import Trajectory
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.turning_clocks import clocks_of_turns


def clock_of(errors: SharedErrors, theta: np.ndarray) -> float:
    return float(theta[errors.names.index("front.clock")])


@pytest.mark.parametrize("clock", [-0.24, 0.1, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_turns_show_the_clock(clock, seed):
    errors = errors_of(drive(seed, clock=clock))
    theta = clocks_of_turns(errors)
    assert clock_of(errors, theta) == pytest.approx(clock, abs=0.06)
    others = [i for i, name in enumerate(errors.names) if name != "front.clock"]
    np.testing.assert_array_equal(theta[others], errors.mean[others])


def test_wrong_labels_and_other_shared_errors_do_not_hide_the_clock():
    wrong = {"front.yaw": 0.05, "odometry.turn_scale": 0.08, "odometry.turn_bias": 0.003}
    log = add_shared_errors(drive(3, clock=0.2, false=0.1), wrong)
    errors = errors_of(log)
    assert clock_of(errors, clocks_of_turns(errors)) == pytest.approx(0.2, abs=0.06)


def test_the_axes_of_base_and_of_the_odometry_do_not_matter():
    """The base of a visual odometry may have the axes of a camera, and its world those of the first image."""
    log = drive(2, clock=0.16)
    odometry, camera = log.odometry, log.cameras[0]
    other_T_base, world_T_odom = (make_pose(Rotation.random(rng=seed).as_matrix(), np.zeros(3)) for seed in (1, 2))
    poses = world_T_odom @ odometry.poses @ inverse(other_T_base)
    mounted = replace(camera, camera=replace(camera.camera, base_T_camera=other_T_base @ camera.camera.base_T_camera))
    errors = errors_of(replace(log, odometry=Trajectory(odometry.stamps, poses), cameras=(mounted,)))
    assert clock_of(errors, clocks_of_turns(errors)) == pytest.approx(0.16, abs=0.06)


def test_a_robot_that_does_not_turn_shows_no_clock():
    errors = errors_of(drive(1, turns=0.0, clock=0.3))
    np.testing.assert_array_equal(clocks_of_turns(errors), errors.mean)


def test_a_clock_that_is_held_stays():
    errors = errors_of(drive(clock=0.2), "calibration.clock=0")
    assert "front.clock" not in errors.names
    np.testing.assert_array_equal(clocks_of_turns(errors), errors.mean)


def test_no_offset_beyond_the_largest_is_found():
    errors = errors_of(drive(clock=0.4), "calibration.max_clock=0.2")
    assert abs(clock_of(errors, clocks_of_turns(errors))) <= 0.2 + 1e-9


def test_odometry_at_the_rate_of_the_images_does_not_look_better_midway():
    """The turns are mostly noise, of which poses midway between two poses of the odometry have less."""
    log, rng = drive(1, turns=0.1), np.random.default_rng(0)
    stamps = np.arange(1.0, 59.0, 0.2)
    walk = np.cumsum(rng.normal(scale=0.02, size=len(stamps)))
    turned = make_pose(Rotation.from_rotvec(np.outer(walk, [0.0, 0.0, 1.0])).as_matrix(), np.zeros((len(stamps), 3)))
    errors = errors_of(replace(log, odometry=Trajectory(stamps, log.odometry.poses[20:1180:4] @ turned)))
    assert abs(clock_of(errors, clocks_of_turns(errors))) < 0.02
