"""The shared errors that tracks of boxes show before any map, on simulated drives with known errors."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from bench_robots import robot
from log_parts import part, without_names
from turning_drive import drive, errors_of

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline, several_starts
from objslam.mapping.exploration.errors_of_tracks import with_errors_of_tracks
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.several_starts import _Found
from objslam.simulation import preset, simulate

TURN_SCALE, TURN_BIAS, CLOCK = "odometry.turn_scale", "odometry.turn_bias", "front.clock"


def begin(log, *overrides):
    errors = errors_of(log, "mode=joint", *overrides)
    cameras = tuple(one.camera for one in log.cameras)
    of_log = errors.keyframes, errors.rays
    return JointState(*of_log, *of_log, cameras, errors.settings, Ledger(), lambda *_: None, None, errors)


def found(state):
    state, path = with_errors_of_tracks(state)
    assert path.shape == state.keyframes.map_T_base.shape
    assert state.estimate is None  # The tracks are no map.
    assert len(state.keyframes) == len(state.errors.keyframes)
    return dict(zip(state.errors.names, state.theta.tolist(), strict=True))


@pytest.mark.parametrize(("scale", "seed", "labels"), [(-0.1, 1, 40), (0.0, 2, 3), (0.08, 4, 1)])
def test_tracks_show_how_far_the_robot_turned(scale, seed, labels):
    log = add_shared_errors(drive(seed, labels=labels), {TURN_SCALE: scale})
    assert found(begin(log))[TURN_SCALE] == pytest.approx(scale, abs=0.02)


def test_wrong_labels_and_other_errors_hide_neither_turns_nor_clock():
    wrong = {"front.yaw": 0.02, TURN_BIAS: 0.003, "odometry.scale": 0.03, TURN_SCALE: -0.05}
    values = found(begin(add_shared_errors(drive(3, false=0.1, labels=3, clock=0.1), wrong)))
    assert values[TURN_SCALE] == pytest.approx(-0.05, abs=0.02)
    assert values[CLOCK] == pytest.approx(0.1, abs=0.02)  # s


def test_tracks_show_the_bias_of_gyroscopes():
    """Two fifths of each drive. A few tracks show little, and then the prior pulls the bias to 0."""
    pairs = []
    for seed in (5002, 5008, 5009):
        log, true = robot(seed, "gyro")
        values = found(begin(without_names(part(log, 0.0, 150.0))))
        assert values[CLOCK] == pytest.approx(true[CLOCK], abs=0.015)  # s
        pairs.append((values[TURN_BIAS], true[TURN_BIAS]))
    biases, truth = np.array(pairs).T
    assert np.sqrt((truth**2).mean()) > 0.004  # rad/s
    assert np.sqrt(((biases - truth) ** 2).mean()) < 0.002
    assert (biases * truth > 0).all()


def test_parts_of_a_long_log_are_enough(monkeypatch):
    from objslam.mapping.exploration import errors_of_tracks

    log = add_shared_errors(drive(1, labels=1), {TURN_SCALE: 0.08})
    assert len(begin(log).rays) > 2500
    monkeypatch.setattr(errors_of_tracks, "_MOST", 1000)
    assert found(begin(log))[TURN_SCALE] == pytest.approx(0.08, abs=0.03)


def test_a_log_without_tracks_keeps_what_is_expected():
    log = drive(1)
    detections = log.cameras[0].detections
    every = np.flatnonzero(detections.frame % 7 == 0)  # More than a second lies between the others.
    camera = replace(log.cameras[0], detections=detections.take(every))
    state = begin(replace(log, cameras=(camera,)))
    assert with_errors_of_tracks(state)[0] is state


def test_turns_that_are_held_stay():
    log = part(add_shared_errors(drive(), {TURN_SCALE: 0.08}), 0.0, 8.0)
    assert TURN_SCALE not in found(begin(log, "calibration.turn_scale=0"))
    state = begin(log, "calibration.use=false")
    assert with_errors_of_tracks(state)[0] is state


def test_a_gyroscope_with_a_bias_is_mapped_without_names():
    """The rays of one minute meet nowhere before the bias is known: 7 of 12 objects were found, and 8 false ones."""
    log = without_names(robot(5007, "gyro")[0])
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false")), Ledger())
    compared = evaluate(result.map, log.truth, align="se2", radius=0.5).to_dict()
    assert tuple(compared[name] for name in ("matched", "false", "missed")) == (12, 0, 0)
    assert result.summary["assessment"]["level"] == "good"


def test_a_start_from_which_nothing_is_solved_loses_no_map():
    def nowhere():
        raise SolveError("no object has enough rays")

    found = _Found(*[begin(drive(1))] * 2)
    assert found.after(nowhere) is found


def test_false_boxes_call_for_no_other_start(monkeypatch):
    """They agree with no object, but they are not in tracks. A quarter of these boxes is false."""

    def another(*_: object) -> None:
        raise AssertionError("a right map was sought again")

    monkeypatch.setattr(several_starts._Found, "after", another)
    log = simulate(preset("demo", frames=200, localization=None, odometry=Odometry(), classes=3, false=0.25), 1)
    settings = load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false"))
    result = pipeline.run(log, settings, Ledger())
    compared = evaluate(result.map, log.truth, align="se2", radius=0.5).to_dict()
    assert tuple(compared[name] for name in ("matched", "false", "missed")) == (12, 0, 0)
    assert (result.association.object < 0).mean() > 0.2
