"""Several cameras whose clocks differ: the noise of the odometry that they share, and what a run finds."""

from dataclasses import replace

import numpy as np
import pytest
from bench_robots import robot
from numpy.testing import assert_allclose

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.frontend import turning_clocks
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.turning_clocks import in_order_of_clocks
from objslam.graph.calibration.clock_instruments import _around
from objslam.graph.calibration.instruments import from_neighbours
from objslam.graph.calibration.noise_in_instruments import _shares
from objslam.mapping import pipeline

SETTINGS = load_settings(None, ("mode=joint", "output.recording=false"))


def test_the_shares_of_noise_belong_to_directions():
    """Two clocks: all noise is common. Their difference is known 100 times better than their mean."""
    both, apart = np.array([1.0, 1.0]) / np.sqrt(2), np.array([1.0, -1.0]) / np.sqrt(2)
    noise = 3.0 * np.outer(both, both)
    information = 4.0 * np.outer(both, both) + 400.0 * np.outer(apart, apart)
    shares = _shares(noise, information, 0.0)
    assert_allclose(information @ shares, noise, atol=1e-9)
    assert_allclose(shares @ both, 0.75 * both, atol=1e-9)
    assert_allclose(shares @ apart, 0, atol=1e-9)
    assert_allclose(_shares(noise, information, 0.2) @ apart, 0.2 * apart, atol=1e-9)  # at least 0.2 in each direction
    assert_allclose(_shares(2 * noise, information, 0.0) @ both, both, atol=1e-9)  # at most all of it


def test_one_clock_has_the_ratio_of_noise_and_information():
    assert_allclose(_shares(np.array([[3.0]]), np.array([[4.0]]), 0.0), [[0.75]])


def test_clocks_without_information_or_that_cannot_be_told_apart_are_no_crash():
    shares = _shares(np.diag([3.0, 0.0]), np.diag([4.0, 0.0]), 0.0)
    assert_allclose(shares, np.diag([0.75, 0.0]), atol=1e-6)
    alike = np.ones((2, 2))
    found = _shares(0.5 * alike, 1e6 * alike, 0.0)
    assert np.isfinite(found).all()
    assert_allclose(1e6 * alike @ found, 0.5 * alike, rtol=1e-3, atol=1e-3)
    with pytest.raises(SolveError, match="not finite"):
        _shares(np.full((2, 2), np.nan), alike, 0.0)


def test_neighbours_of_equal_durations_are_two_on_each_side():
    motions = np.random.default_rng(0).normal(size=(30, 2))
    found = from_neighbours(motions, np.full(30, 0.2), 0.0)
    for i in range(3, 27):
        assert_allclose(found[i], motions[[i - 3, i - 2, i + 2, i + 3]].mean(axis=0))


@pytest.mark.parametrize("cameras", [1, 2, 4, 7])
def test_neighbours_of_the_frames_of_a_rig_are_of_other_moments(cameras):
    """The frames of a moment are 3 ms apart. Each motion has noise of 1 mm. Over 3 ms this would be a speed of 0.3 m/s."""
    rng = np.random.default_rng(1)
    seconds = np.tile(np.append(np.full(cameras - 1, 0.003), 0.2), 50)
    motions = (0.5 * seconds + 0.001 * rng.normal(size=len(seconds)))[:, None]
    found = from_neighbours(motions, seconds, 0.025)[:, 0] / seconds
    assert np.abs(found - 0.5).max() < 0.05
    beside = np.flatnonzero(seconds > 0.1)[5]  # The motion beside it, over the same step of the odometry, does not count.
    bumped = motions.copy()
    bumped[beside + 1 : beside + cameras] += 1.0
    assert_allclose(from_neighbours(bumped, seconds, 0.025)[beside], from_neighbours(motions, seconds, 0.025)[beside])


def test_no_motions_have_no_neighbours():
    assert from_neighbours(np.zeros((0, 3)), np.zeros(0), 0.0).shape == (0, 3)
    assert_allclose(from_neighbours(np.ones((1, 3)), np.ones(1), 0.0), 0)


def test_the_velocity_of_a_pose_is_over_a_while():
    stamps = np.array([0.0, 0.002, 0.004, 0.2, 0.202, 0.204, 0.4, 0.402])
    before, after = _around(stamps, np.ones(7, dtype=bool), 0.05)
    assert before.tolist() == [0, 0, 0, 2, 2, 2, 5, 5]
    assert after.tolist() == [3, 3, 3, 6, 6, 6, 7, 7]
    before, after = _around(stamps, np.array([True, True, True, False, True, True, True]), 0.05)
    assert before.tolist() == [0, 0, 0, 2, 4, 4, 5, 5]
    assert after.tolist() == [3, 3, 3, 3, 6, 6, 7, 7]


def measured(log):
    frames = build_keyframes(log, SETTINGS, Ledger())
    rays = build_rays(log, frames, SETTINGS, Ledger())
    return frames, rays, shared_errors(log, frames, rays, SETTINGS)


def test_frames_are_in_the_order_in_which_they_were_taken():
    """The clocks differ by up to 0.07 s, which is more than the time between two frames."""
    log, true = robot(1, "gyro", None, 3)
    frames, rays, errors = measured(log)
    found, moved = in_order_of_clocks(frames, rays, errors)
    clock = np.array([true[f"{one.camera.name}.clock"] for one in log.cameras])
    back = [np.minimum(np.diff(one.stamps + clock[one.camera]), 0).sum() for one in (frames, found)]
    assert back[0] < -100
    assert back[1] > -0.1
    assert (np.diff(moved.keyframe) >= 0).all()
    assert sorted(zip(found.camera, found.frame, strict=True)) == sorted(zip(frames.camera, frames.frame, strict=True))
    (was, now) = (
        {(one.camera[k], one.frame[k], *box) for k, box in zip(of.keyframe, of.box.tolist(), strict=True)}
        for one, of in ((frames, rays), (found, moved))
    )
    assert now == was


def test_images_of_cameras_with_a_common_trigger_stay_together(monkeypatch):
    """A clock that is found 0.3 s off would tear them apart."""
    log = robot(1, "gyro", None, 3)[0]
    stamps = log.cameras[0].detections.frame_stamps
    cameras = (replace(one, detections=replace(one.detections, frame_stamps=stamps)) for one in log.cameras)
    frames, rays, errors = measured(replace(log, cameras=tuple(cameras)))
    theta = np.where([name == "camera1.clock" for name in errors.names], 0.3, 0.0)
    monkeypatch.setattr(turning_clocks, "clocks_of_turns", lambda errors: theta)
    assert in_order_of_clocks(frames, rays, errors) == (frames, rays)


def test_one_camera_keeps_its_order():
    frames, rays, errors = measured(robot(3, "gyro")[0])
    assert in_order_of_clocks(frames, rays, errors) == (frames, rays)


def test_a_run_finds_the_clocks_of_a_rig():
    """Three cameras, whose images are a few milliseconds apart, and whose clocks are not."""
    log, true = robot(7, "gyro", None, 3)
    alone = ("checks.use=false", "bodies.use=false", "association.method=by_label", "output.recording=false")
    result = pipeline.run(log, load_settings(None, ("mode=joint", *alone)), Ledger())
    found = result.calibration
    at = [i for i, name in enumerate(found.names) if name.endswith(".clock")]
    off = found.values[at] - [true[found.names[i]] for i in at]
    assert len(at) == 3
    assert (np.abs(off) < 3 * found.sigma[at]).all()
    assert found.sigma[at].max() < 0.02
    judged = evaluate(result.map, log.truth, align="se2", radius=3.0).to_dict()
    assert judged["matched"] == len(log.truth.objects)
    assert judged["inside_95_3d"] > 0.85
