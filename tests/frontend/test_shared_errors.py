"""Errors that all measurements share: put into a simulated log by one function, taken out again by another."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from added_errors import add_shared_errors
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from objslam.config import load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.noise import NoiseFactors
from objslam.core.trajectory import Trajectory, correct_poses
from objslam.core.types import Images
from objslam.errors import ConfigError
from objslam.frontend.bearings import build_rays
from objslam.frontend.corrected_log import refocused, take_out
from objslam.frontend.corrected_odometry import ODOMETRY, CorrectablePath
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors, take_out_known
from objslam.frontend.odometry_drift import gathered_drift
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.surface_ranges import measured_ranges
from objslam.graph.factors.odometry import motions
from objslam.io.calibration_yaml import dump_calibration
from objslam.simulation import DepthNoise, make_camera, preset, simulate

SETTINGS = load_settings(
    None,
    (
        "mode=joint",
        "calibration.turn_per_m=0.01",
        "calibration.focal=0.01",
        "calibration.translation=0.01",
        "calibration.centre=0.01",
    ),
)
ERRORS = {
    "odometry.scale": -0.04,
    "odometry.turn_scale": 0.06,
    "odometry.turn_bias": 0.002,
    "odometry.turn_per_m": 0.01,
    "front.clock": 0.17,
    "front.roll": 0.02,
    "front.tilt": -0.03,
    "front.yaw": 0.05,
    "range_scale": 0.02,
    "range_offset": 0.06,
}


@pytest.fixture(scope="module")
def clean():
    changes = {"frames": 120, "pixel_sigma": 0.0, "missed": 0.0, "false": 0.0, "localization": None, "odometry_rate": 100.0}
    return simulate(preset("demo", **changes, depth=DepthNoise(sigma=0, sigma_per_m=0), cameras=(make_camera("front"),)), 3)


def test_all_noise_of_ranges_follows_their_scale():
    """Else, a smaller map would fit better."""
    log, ledger = simulate(preset("demo", frames=120, depth=DepthNoise(), cameras=(make_camera("front"),)), 3), Ledger()
    keyframes = build_keyframes(log, SETTINGS, ledger)
    errors = shared_errors(log, keyframes, build_rays(log, keyframes, SETTINGS, ledger), SETTINGS)
    larger = np.where(np.array(errors.names) == "range_scale", 1.1 * (1 + errors.mean) - 1, errors.mean)
    (_, rays, _), (_, longer, _) = errors.at(errors.mean), errors.at(larger)
    assert np.isfinite(rays.range).any()
    for name in ("range", "range_sigma", "range_bias"):
        assert_allclose(getattr(longer, name), 1.1 * getattr(rays, name))


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
    assert_allclose(rays.range, true_rays.range[some], atol=0.1 * ERRORS["range_offset"])  # It counts after the surfaces.


def test_no_error_changes_nothing(clean):
    keyframes, rays, errors = measured(add_shared_errors(clean, ERRORS))
    same, same_rays, settings = errors.at(np.zeros(len(errors.names)))
    for name in ("stamps", "base_T_camera", "map_T_base", "odom_T_base", "drift"):
        assert_allclose(getattr(same, name), getattr(keyframes, name), atol=1e-12)
    assert_allclose(same_rays.range, rays.range)
    assert_allclose(same_rays.direction, rays.direction)
    assert settings == SETTINGS


@pytest.mark.parametrize(("noise", "same"), [({"turning": 2.0, "heading": 3.0}, True), ({"shrinkage": 0.02}, False)])
def test_other_noise_needs_new_poses_only_if_it_moves_them(clean, monkeypatch, noise, same):
    """Only the shrinkage does: it lengthens the odometry."""
    errors = measured(add_shared_errors(clean, ERRORS))[2]
    values, made, compute = np.full(len(errors.names), 0.01), [], SharedErrors._computed_poses
    monkeypatch.setattr(SharedErrors, "_computed_poses", lambda *args: made.append(args) or compute(*args))
    before, *_ = errors.at(values)
    after, *_ = errors.with_noise(NoiseFactors(**noise)).at(values)
    anew, *_ = replace(errors, noise=NoiseFactors(**noise)).at(values)
    assert len(made) == (2 if same else 3)
    assert np.allclose(before.map_T_base, after.map_T_base) == same
    for name in ("stamps", "map_T_base", "odom_T_base", "base_T_camera", "drift"):
        assert_allclose(getattr(after, name), getattr(anew, name), rtol=0, atol=0)


def test_other_errors_of_one_odometry_share_its_corrected_paths(clean, monkeypatch):
    """A freed error and a second camera change no path of the odometry. Other keyframes have other poses."""
    log = add_shared_errors(clean, ERRORS)
    keyframes, rays, errors = measured(log)
    values, made, poses = np.full(len(errors.names), 0.01), [], []
    init, compute = CorrectablePath.__init__, SharedErrors._computed_poses
    monkeypatch.setattr(CorrectablePath, "__init__", lambda *args: made.append(args) or init(*args))
    monkeypatch.setattr(SharedErrors, "_computed_poses", lambda *args: poses.append(args) or compute(*args))
    errors.at(values)
    same, fewer = shared_errors(log, keyframes, rays, SETTINGS), keyframes.take(np.arange(60))
    others = [same, replace(same, keyframes=fewer, rays=rays.take(rays.keyframe < 60))]
    for other, more in zip(others, (0, 1), strict=True):
        poses.clear()
        found, *_ = other.with_paths_of(errors).at(values)
        assert (len(made), len(poses)) == (1, more)
        anew, *_ = replace(other, _path=[]).at(values)
        made.pop()
        for name in ("stamps", "map_T_base", "odom_T_base", "base_T_camera", "drift", "step", "wander"):
            assert_allclose(getattr(found, name), getattr(anew, name), rtol=0, atol=0)
    slower = replace(log, odometry=replace(log.odometry, stamps=2 * log.odometry.stamps))
    other = replace(same, log=slower)
    assert other.with_paths_of(errors) is other


def test_a_second_round_of_derivatives_needs_no_new_path(clean):
    """The scale only lengthens a path, and a clock only moves stamps. The other five errors give a path each."""
    path, computed = CorrectablePath(clean.odometry), []
    get = path._moved.get
    path._moved.get = lambda key, compute: get(key, lambda: computed.append(key) or compute())
    here = dict.fromkeys(ODOMETRY, 0.01)
    for _ in range(2):
        for changed in (None, *ODOMETRY, None):
            path.poses(here if changed is None else {**here, changed: 0.02})
    assert len(computed) == 6


def test_the_corrected_log_has_the_same_keyframes(clean):
    _, _, errors = measured(add_shared_errors(clean, ERRORS))
    values = vector(errors, {**ERRORS, "front.x": 0.1, "front.focal": 0.03, "front.cx": 0.02, "front.cy": -0.01})
    found, rays, _ = errors.at(values)
    again, again_rays, _ = measured(errors.corrected_log(values))
    end = errors.log.odometry.stamps[-1] - ERRORS["front.clock"] - 1e-3
    on_path = errors.keyframes.frame[errors.keyframes.stamps <= end]  # the others are squeezed into its last millisecond
    ours, theirs = (np.isin(one.frame, on_path) for one in (found, again))
    assert ours.sum() == len(on_path) > 110
    assert_allclose(found.odom_T_base[ours], again.odom_T_base[theirs], atol=1e-9)
    assert_allclose(found.base_T_camera[ours], again.base_T_camera[theirs], atol=1e-9)
    here, there = (np.isin(r.keyframe, np.flatnonzero(k)) for r, k in ((rays, ours), (again_rays, theirs)))
    assert_allclose(rays.direction[here], again_rays.direction[there], atol=1e-9)
    assert_allclose(rays.sigma[here], again_rays.sigma[there], rtol=0.03)  # it changes a little with the place in the image


def test_noise_is_scaled_with_what_it_belongs_to(clean):
    """If the noise were not scaled, a smaller world would fit the odometry better, and the estimated scale would diverge."""
    log = replace(clean, cameras=tuple(replace(c, camera=replace(c.camera, base_T_camera=np.eye(4))) for c in clean.cameras))
    _, _, errors = measured(log)
    scaled, _, settings = errors.at(vector(errors, {"odometry.scale": 0.2}))
    before, after = motions(errors.keyframes, SETTINGS)[1], motions(scaled, settings)[1]
    yaw, x, y = 2, 3, 4
    assert_allclose(
        after[:, yaw, yaw] / before[:, yaw, yaw], 1.0, rtol=2e-3
    )  # turns err by themselves, whatever their scale
    assert_allclose(after[:, x, x] / before[:, x, x], 1.2**2, rtol=5e-3)
    assert_allclose(after[:, y, y] / before[:, y, y], 1.2**2, rtol=0.05)  # the turns on the way add a lever arm


@pytest.mark.parametrize(
    ("overrides", "there", "missing"),
    [
        ((), ("odometry.scale", "front.clock", "front.yaw", "front.cx", "range_offset"), ("front.focal", "front.x")),
        (("depth.use=false",), ("odometry.scale",), ("range_scale", "range_offset")),
        (("calibration.yaw=0", "calibration.scale=0"), ("front.roll",), ("front.yaw", "odometry.scale")),
    ],
)
def test_parameters_are_what_was_measured_and_is_not_held(clean, overrides, there, missing):
    _, _, errors = measured(clean, load_settings(None, ("mode=joint", *overrides)))
    assert set(there) <= set(errors.names)
    assert not set(missing) & set(errors.names)


def test_at_fixed_poses_only_cameras_have_errors(clean):
    """Bearings from known poses tell nothing of odometry and of ranges; odometry is no known pose."""
    asked = load_settings(None, ("mode=fixed", "calibration.use=true"))
    _, _, errors = measured(replace(clean, localization=clean.odometry), asked)
    kinds = ("clock", "roll", "tilt", "yaw", "focal", "cx", "cy", "x", "y", "z")
    assert errors.names == tuple(f"front.{kind}" for kind in kinds)
    assert measured(clean, asked)[2] is None


KNOWN_NOISE = tuple(f"noise.{name}=false" for name in ("rays", "ranges", "odometry"))


@pytest.mark.parametrize("overrides", [("mode=fixed",), ("mode=joint", "calibration.use=false", *KNOWN_NOISE)])
def test_nothing_is_estimated_if_the_settings_say_so(clean, overrides):
    assert measured(clean, load_settings(None, overrides))[2] is None


def test_frames_that_leave_the_path_take_its_end(clean):
    short = Trajectory(clean.odometry.stamps[:400], clean.odometry.poses[:400])
    keyframes, _, errors = measured(replace(clean, odometry=short))
    found, _, _ = errors.at(vector(errors, {"front.clock": 0.5}))
    assert len(found) == len(keyframes)
    assert_allclose(found.odom_T_base[-1], np.linalg.inv(short.poses[0]) @ short.poses[-1], atol=1e-12)


@pytest.mark.parametrize("clock", [0.17, -0.17])
def test_every_frame_that_was_on_the_path_stays_on_it(clean, clock):
    """Boxes, images and keyframes get one stamp, and it is inside the path, so that an image has a pose."""
    one = clean.cameras[0]
    images = Images(one.detections.frame_stamps, tuple(Path(f"{i}.png") for i in range(len(one.detections.frame_stamps))))
    log = replace(clean, cameras=(replace(one, rgb=images, depth=images),))
    keyframes, _, errors = measured(log)
    values = vector(errors, {"front.clock": clock})
    found, corrected = errors.at(values)[0], errors.corrected_log(values)
    begin, end = clean.odometry.stamps[[0, -1]]
    assert not ((keyframes.stamps + clock >= begin) & (keyframes.stamps + clock <= end)).all()
    assert ((found.stamps >= begin) & (found.stamps <= end)).all()
    assert (np.diff(found.stamps) > 0).all()
    camera = corrected.cameras[0]
    for stamps in (camera.detections.frame_stamps, camera.rgb.stamps, camera.depth.stamps):
        np.testing.assert_array_equal(stamps[found.frame], found.stamps)


def test_frames_off_the_path_are_not_pulled_onto_it(clean):
    short = Trajectory(clean.odometry.stamps[:400], clean.odometry.poses[:400])
    log = replace(clean, odometry=short, localization=None)
    _, _, errors = measured(log)
    stamps = log.cameras[0].detections.frame_stamps
    moved = errors.corrected_log(vector(errors, {"front.clock": 0.2})).cameras[0].detections.frame_stamps
    off = stamps > short.stamps[-1]
    assert off.any()
    assert_allclose(moved[off], stamps[off] + 0.2)


def test_cameras_with_different_clocks_keep_a_drift_that_grows(clean):
    """In the order of the log for the graph, and in the order of time for what sorts the keyframes by their stamps."""
    one = clean.cameras[0]
    between = one.detections.frame_stamps[:-1] + 0.5 * np.diff(one.detections.frame_stamps)
    boxes = one.detections.take(one.detections.frame < len(between))
    left = replace(one, camera=replace(one.camera, name="left"), detections=replace(boxes, frame_stamps=between))
    _, _, errors = measured(replace(clean, cameras=(one, left)))
    values = vector(errors, {"front.clock": 0.5, "left.clock": -0.5})
    found, _, _ = errors.at(values)
    assert (np.diff(found.stamps) < 0).any()
    for camera in (0, 1):
        assert (np.diff(found.stamps[found.camera == camera]) > 0).all()
    variance = np.trace(found.drift, axis1=1, axis2=2)
    assert (np.diff(variance) >= 0).all()
    order = np.argsort(found.stamps)
    timed = errors.drift_at_stamps(found, values).take(order)
    assert (np.diff(variance[order]) < 0).any()
    assert (np.linalg.eigvalsh(np.diff(timed.drift, axis=0)) > -1e-12).all()
    assert_allclose(timed.drift, gathered_drift(clean.odometry, timed.stamps, SETTINGS.odometry), atol=1e-12)
    at = correct_poses(clean.odometry.stamps, clean.odometry.poses, found.stamps, found.map_T_base, found.map_T_base)
    assert_allclose(at, clean.odometry.poses, atol=1e-9)


def test_a_wide_prior_leaves_something_of_what_was_measured(clean):
    wide = load_settings(
        None, ("mode=joint", "calibration.scale=2", "calibration.turn_scale=2", "calibration.range_scale=1")
    )
    _, _, errors = measured(clean, wide)
    for sign in (-1, 1):
        _, rays, settings = errors.at(sign * errors.bounds)
        numbers = [getattr(settings.odometry, name) for name in ("x_per_m", "xy_per_rad", "yaw_per_rad", "floor_xy")]
        assert (np.array(numbers) > 0).all()
        assert (rays.range[np.isfinite(rays.range)] > 0).all()


def write_known(tmp_path, values, sigma=0.001):
    known = Calibration(
        tuple(values), np.array(list(values.values())), sigma**2 * np.eye(len(values)), np.full(len(values), 0.1)
    )
    (tmp_path / "robot.yaml").write_text(dump_calibration(known))
    return f"calibration.file={tmp_path}/robot.yaml"


@pytest.mark.parametrize(
    "overrides", [("mode=fixed",), ("mode=fixed", "calibration.use=true"), ("mode=joint", "calibration.use=false")]
)
def test_known_errors_are_taken_out_where_none_is_estimated(clean, tmp_path, overrides):
    """A log without localisation tells none in fixed mode, also where that is asked for."""
    settings = load_settings(None, (*overrides, write_known(tmp_path, ERRORS)))
    ledger = Ledger()
    log = take_out_known(add_shared_errors(clean, ERRORS), settings, ledger)
    assert ledger.warnings == []
    true, one = clean.cameras[0], log.cameras[0]
    assert_allclose(one.detections.frame_stamps, true.detections.frame_stamps, atol=1e-9)
    assert_allclose(one.detections.depths, true.detections.depths, rtol=1e-9)
    assert_allclose(one.camera.base_T_camera, true.camera.base_T_camera, atol=1e-9)
    assert_allclose(log.odometry.poses[:, :3, 3], clean.odometry.poses[:, :3, 3], atol=1e-3)


def test_an_error_that_the_settings_hold_is_held_at_the_known_value(clean, tmp_path):
    settings = load_settings(
        None, ("mode=joint", "calibration.yaw=0", "calibration.turn_per_m=0.01", write_known(tmp_path, ERRORS))
    )
    log = take_out_known(clean, settings, Ledger())
    turn = log.cameras[0].camera.base_T_camera[:3, :3] @ clean.cameras[0].camera.base_T_camera[:3, :3].T
    assert_allclose(Rotation.from_matrix(turn).as_rotvec(), [0, 0, ERRORS["front.yaw"]], atol=1e-12)
    assert_allclose(log.odometry.poses, clean.odometry.poses)
    _, _, errors = measured(log, settings)
    assert "front.yaw" not in errors.names
    assert_allclose(errors.mean, vector(errors, ERRORS))


def test_a_run_at_fixed_poses_begins_at_the_known_cameras_and_takes_the_rest_out(clean, tmp_path):
    settings = load_settings(None, ("mode=fixed", "calibration.use=true", write_known(tmp_path, ERRORS)))
    log = take_out_known(replace(clean, localization=clean.odometry), settings, Ledger())
    assert_allclose(log.cameras[0].camera.base_T_camera, clean.cameras[0].camera.base_T_camera)
    assert_allclose(
        log.cameras[0].detections.depths,
        clean.cameras[0].detections.depths * (1 + ERRORS["range_scale"]) + ERRORS["range_offset"],
        rtol=1e-9,
    )
    _, _, errors = measured(log, settings)
    assert_allclose(errors.mean, vector(errors, ERRORS))


def test_names_that_the_log_does_not_have_are_said(clean, tmp_path):
    ledger = Ledger()
    settings = load_settings(None, ("mode=joint", write_known(tmp_path, {"front.yaw": 0.1, "rear.yaw": 0.2})))
    take_out_known(clean, settings, ledger)
    (said,) = ledger.warnings
    assert "rear.yaw" in said
    assert "front.yaw" not in said
    settings = load_settings(None, ("mode=joint", write_known(tmp_path, {"rear.yaw": 0.2})))
    with pytest.raises(ConfigError, match=r"robot\.yaml.*rear\.yaw.*cameras: front"):
        take_out_known(clean, settings, Ledger())


def test_an_offset_never_turns_a_short_depth_round(clean):
    """A depth of 5 cm with an offset of -10 cm stays in front of the camera, and nothing is divided by zero."""
    one = clean.cameras[0]
    depths = np.where(np.isfinite(one.detections.depths), 0.05, np.nan)
    log = replace(clean, cameras=(replace(one, detections=replace(one.detections, depths=depths)),))
    corrected = take_out(log, {"range_offset": -0.1}).cameras[0].detections.depths
    assert (corrected[np.isfinite(depths)] > 0).all()
    assert np.isnan(corrected[np.isnan(depths)]).all()
    with np.errstate(all="raise"):  # A fisheye sees things beside it, where a ray has no depth.
        assert_allclose(measured_ranges({}, np.array([2.0]), np.array([[1.0, 0.0, 0.0]]), np.ones(1)), 2.0)


@pytest.mark.parametrize("lens", [(-0.05, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.06, -0.04), (-0.05, 0.04, 0.02)])
@pytest.mark.parametrize("off", [0, 20, 40])
def test_another_lens_does_not_fit_noise_better(lens, off):
    """Drawn noise of directions, before and after the correction of a lens. In units of its sigma, it stays as large.

    With one factor for the whole image, noise at its edge was 3 % larger or smaller for a focal length of 5 %. So all rays
    together asked for a shorter focal length: 4 % for a camera that looks to the side.
    """
    rng, sigma = np.random.default_rng(0), 1e-3
    around = rng.uniform(0, 2 * np.pi, 100_000)
    tip = np.tan(np.radians(off))
    true = np.column_stack([tip * np.cos(around), tip * np.sin(around), np.ones_like(around)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    noise = sigma * rng.normal(size=true.shape)
    seen = true + noise - true * (noise * true).sum(axis=1, keepdims=True)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    (moved, factors), (moved_seen, _) = refocused(true, lens), refocused(seen, lens)
    after = np.linalg.norm(np.cross(moved, moved_seen), axis=1) / (sigma * factors)
    assert np.mean(after**2) / 2 == pytest.approx(1.0, abs=0.012)
    each = np.where(np.arange(len(true))[:, None] % 2 == 0, lens, 0.0)
    assert refocused(true, each)[1][1::2] == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(refocused(true, each)[0][::2], moved[::2], rtol=1e-12)


def test_rays_that_are_put_in_come_out_at_the_same_errors(clean):
    """Also for a lens and ranges with errors. A range shorter than its offset stays above 0."""
    _, _, errors = measured(clean)
    values = vector(errors, {"front.focal": 0.03, "front.cx": -0.02, "range_scale": 0.04, "range_offset": 0.1})
    rng, count = np.random.default_rng(0), len(errors.rays)
    direction = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    ranges = rng.uniform(0.5, 5.0, count)
    _, rays, _ = errors.with_rays(direction, ranges, values).at(values)
    assert_allclose(rays.direction, direction, atol=1e-12)
    assert_allclose(rays.range, ranges, rtol=1e-12)
    short = errors.with_rays(direction, np.full(count, 0.05), values)
    assert (short.rays.range > 0).all()
    assert (short.at(values)[1].range > 0).all()
