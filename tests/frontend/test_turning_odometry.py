"""The error of the odometry's turns from tracks of boxes alone, on simulated drives whose odometry errs by a known share."""

import numpy as np
import pytest
from added_errors import add_shared_errors
from turning_drive import drive, errors_of

from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.turning_odometry import TURN_SCALE, with_turns_of_tracks


def found(errors: SharedErrors) -> float:
    theta = with_turns_of_tracks(errors, errors.mean)
    number = errors.names.index(TURN_SCALE)
    np.testing.assert_array_equal(np.delete(theta, number), np.delete(errors.mean, number))
    return float(theta[number])


@pytest.mark.parametrize("scale", [-0.1, 0.0, 0.08])
@pytest.mark.parametrize(("seed", "labels"), [(1, 40), (2, 3)])
def test_tracks_show_how_far_the_robot_turned(scale, seed, labels):
    log = add_shared_errors(drive(seed, labels=labels), {TURN_SCALE: scale})
    assert found(errors_of(log)) == pytest.approx(scale, abs=0.015)


def test_wrong_labels_and_other_shared_errors_do_not_hide_the_turns():
    wrong = {"front.yaw": 0.05, "odometry.turn_bias": 0.003, "odometry.scale": 0.05, TURN_SCALE: -0.08}
    log = add_shared_errors(drive(3, false=0.1, labels=3), wrong)
    assert found(errors_of(log)) == pytest.approx(-0.08, abs=0.02)


def test_a_log_that_tells_nothing_of_turns_keeps_what_is_expected():
    log = add_shared_errors(drive(1, turns=0.0), {TURN_SCALE: 0.08})
    assert found(errors_of(log)) == 0.0


def test_turns_that_are_held_stay():
    errors = errors_of(add_shared_errors(drive(), {TURN_SCALE: 0.08}), "calibration.turn_scale=0")
    assert TURN_SCALE not in errors.names
    np.testing.assert_array_equal(with_turns_of_tracks(errors, errors.mean), errors.mean)
