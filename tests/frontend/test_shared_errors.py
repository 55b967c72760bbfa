"""Errors that all measurements share: put into a simulated log by one function, taken out again by another."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Trajectory
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.shared_errors import shared_errors
from objslam.graph.factors.odometry import motions
from objslam.simulation import DepthNoise, make_camera, preset, simulate
from objslam.simulation.shared_errors import add_shared_errors

SETTINGS = load_settings(None, ("mode=joint", "calibration.focal=0.01", "calibration.translation=0.01"))
ERRORS = {
    "odometry.scale": -0.04,
    "odometry.turn_scale": 0.06,
    "odometry.turn_bias": 0.002,
    "front.clock": 0.17,
    "front.roll": 0.02,
    "front.tilt": -0.03,
    "front.yaw": 0.05,
    "range_scale": 0.02,
}


@pytest.fixture(scope="module")
def clean():
    changes = {"frames": 120, "pixel_sigma": 0.0, "missed": 0.0, "false": 0.0, "localization": None, "odometry_rate": 100.0}
    return simulate(preset("demo", **changes, depth=DepthNoise(sigma=0, sigma_per_m=0), cameras=(make_camera("front"),)), 3)


def measured(log, settings=SETTINGS):
    keyframes = build_keyframes(log, settings, Ledger())
    rays = build_rays(log, keyframes, settings, Ledger())
    return keyframes, rays, shared_errors(log, keyframes, rays, settings)


def vector(errors, values):
    return np.array([values.get(name, 0.0) for name in errors.names])


def test_what_was_put_into_a_log_is_taken_out_again(clean):
    true, true_rays, _ = measured(clean)
    keyframes, _, errors = measured(add_shared_errors(clean, ERRORS))
    found, rays, _ = errors.at(vector(errors, ERRORS))
    both = np.isin(true.frame, keyframes.frame)  # the clock moves some frames off the odometry
    assert both.sum() > 110
    assert_allclose(found.stamps, true.stamps[both], atol=1e-9)
    assert_allclose(found.base_T_camera, true.base_T_camera[both], atol=1e-9)
    assert_allclose(found.odom_T_base[:, :3, 3], true.odom_T_base[both][:, :3, 3], atol=1e-3)
    assert_allclose(found.odom_T_base[:, :3, :3], true.odom_T_base[both][:, :3, :3], atol=1e-4)
    some = np.isin(true_rays.keyframe, np.flatnonzero(both))
    assert_allclose(rays.range, true_rays.range[some], rtol=1e-9)


def test_no_error_changes_nothing(clean):
    keyframes, rays, errors = measured(add_shared_errors(clean, ERRORS))
    same, same_rays, settings = errors.at(np.zeros(len(errors.names)))
    for name in ("stamps", "base_T_camera", "map_T_base", "odom_T_base", "drift"):
        assert_allclose(getattr(same, name), getattr(keyframes, name), atol=1e-12)
    assert_allclose(same_rays.range, rays.range)
    assert_allclose(same_rays.direction, rays.direction)
    assert settings == SETTINGS


def test_the_corrected_log_has_the_same_keyframes(clean):
    _, _, errors = measured(add_shared_errors(clean, ERRORS))
    values = vector(errors, {**ERRORS, "front.x": 0.1, "front.focal": 0.03})
    found, rays, _ = errors.at(values)
    again, again_rays, _ = measured(errors.corrected_log(values))
    ours, theirs = (
        np.isin(found.frame, again.frame),
        np.isin(again.frame, found.frame),
    )  # one that leaves the path is dropped
    assert ours.sum() > 110
    assert_allclose(found.odom_T_base[ours], again.odom_T_base[theirs], atol=1e-9)
    assert_allclose(found.base_T_camera[ours], again.base_T_camera[theirs], atol=1e-9)
    here, there = (np.isin(r.keyframe, np.flatnonzero(k)) for r, k in ((rays, ours), (again_rays, theirs)))
    assert_allclose(rays.direction[here], again_rays.direction[there], atol=1e-9)


def test_noise_is_scaled_with_what_it_belongs_to(clean):
    """Otherwise a smaller world would fit the odometry better, and the scale would run away."""
    log = replace(clean, cameras=tuple(replace(c, camera=replace(c.camera, base_T_camera=np.eye(4))) for c in clean.cameras))
    _, _, errors = measured(log)
    scaled, _, settings = errors.at(vector(errors, {"odometry.scale": 0.2, "odometry.turn_scale": -0.1}))
    before, after = motions(errors.keyframes, SETTINGS)[1], motions(scaled, settings)[1]
    yaw, x, y = 2, 3, 4
    assert_allclose(after[:, yaw, yaw] / before[:, yaw, yaw], 0.9**2, rtol=2e-3)
    assert_allclose(after[:, x, x] / before[:, x, x], 1.2**2, rtol=5e-3)
    assert_allclose(after[:, y, y] / before[:, y, y], 1.2**2, rtol=0.05)  # the turns on the way add a lever arm


@pytest.mark.parametrize(
    ("overrides", "there", "missing"),
    [
        ((), ("odometry.scale", "front.clock", "front.yaw", "range_scale"), ("front.focal", "front.x")),
        (("depth.use=false",), ("odometry.scale",), ("range_scale",)),
        (("calibration.yaw=0", "calibration.scale=0"), ("front.roll",), ("front.yaw", "odometry.scale")),
        (("mode=fixed", "calibration.use=true"), ("front.clock", "front.yaw"), ("odometry.scale",)),
    ],
)
def test_parameters_are_what_was_measured_and_is_not_held(clean, overrides, there, missing):
    _, _, errors = measured(clean, load_settings(None, ("mode=joint", *overrides)))
    assert set(there) <= set(errors.names)
    assert not set(missing) & set(errors.names)


@pytest.mark.parametrize("overrides", [("mode=fixed",), ("mode=joint", "calibration.use=false")])
def test_nothing_is_estimated_if_the_settings_say_so(clean, overrides):
    assert measured(clean, load_settings(None, overrides))[2] is None


def test_frames_that_leave_the_path_take_its_end(clean):
    short = Trajectory(clean.odometry.stamps[:400], clean.odometry.poses[:400])
    keyframes, _, errors = measured(replace(clean, odometry=short))
    found, _, _ = errors.at(vector(errors, {"front.clock": 0.5}))
    assert len(found) == len(keyframes)
    assert_allclose(found.odom_T_base[-1], np.linalg.inv(short.poses[0]) @ short.poses[-1], atol=1e-12)
