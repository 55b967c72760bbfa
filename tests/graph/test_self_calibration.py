"""The joint solve with shared errors: against brute force, the errors that were put in, and what a log cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from drives import circle_log, drive_of
from numpy.testing import assert_allclose
from scipy.stats import chi2

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.noise import NoiseFactors
from objslam.core.trajectory import Trajectory
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.graph.assembly import Measurements
from objslam.graph.batch_solver import solve_joint
from objslam.graph.calibration import correlated_errors, parameter_columns, self_calibration
from objslam.graph.calibration.correlated_errors import correlation_factors
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.noise_in_instruments import noise_shares
from objslam.graph.calibration.shared_error_jacobian import linearise
from objslam.graph.calibration.variance_components import correlation_time
from objslam.graph.optimizers import build_graph, levenberg_marquardt
from objslam.graph.variables import make_values, read_poses, with_points
from objslam.io.calibration_yaml import dump_calibration
from objslam.simulation import DepthNoise, PoseNoise, preset, simulate

ERRORS = {
    "odometry.scale": -0.03,
    "odometry.turn_scale": 0.05,
    "odometry.turn_slip": 0.04,
    "range_offset": -0.06,
    "front.clock": 0.12,
    "front.roll": 0.015,
    "front.tilt": -0.02,
    "front.yaw": 0.03,
}


def drive(errors, seed=1, overrides=(), **changes):
    settings = load_settings(None, ("mode=joint", "depth.bias=0", *overrides))
    changes = {"frames": 300, "objects": 12, "classes": 12, "localization": None, "odometry": Odometry(), **changes}
    log = simulate(preset("demo", **{"pixel_sigma": 3.0, **changes}), seed)
    log = add_shared_errors(log, errors)
    made = drive_of(log, settings)
    return made, shared_errors(log, made.keyframes, made.rays, settings)


def solve(made, errors):
    return solve_joint(made.keyframes, made.rays, made.association, made.settings, Ledger(), errors=errors)


def optimum(errors: SharedErrors, theta, made, start):
    """Camera poses, positions, cost and measurements of the solve with held parameters, for all rays."""
    measured = Measurements.of(*errors.at(theta))
    landmarks = np.arange(made.association.count)
    which = np.arange(len(made.rays))
    graph = build_graph(measured.factors(made.association.object, which, landmarks, start[1]))
    found = levenberg_marquardt(graph, make_values(start[0], start[1], landmarks), 200, 1e-14)
    places = with_points(start[1], landmarks, found.values)
    return read_poses(found.values), places, found.cost_after, measured


@pytest.mark.parametrize("localization", [None, PoseNoise()])
def test_the_reduced_system_is_that_of_solving_anew(localization):
    """Brute force: solve at parameters that differ a little; the positions move as the sensitivity says.

    Without noise, because Gauss and Newton leave out the curvature of what does not fit, and of robust losses.
    """
    more = ("calibration.focal=0.01", "calibration.translation=0.01")
    exact = {"pixel_sigma": 0.0, "depth": DepthNoise(sigma=0, sigma_per_m=0), "odometry": PoseNoise(), "missed": 0.0}
    made, errors = drive({}, overrides=more, frames=200, false=0.0, localization=localization, **exact)
    theta = np.zeros(len(errors.names))
    true = made.map_T_base @ made.keyframes.base_T_camera
    start = (made.keyframes.map_T_camera[0] @ inverse(true[0])) @ true, made.points
    poses, places, _, measured = optimum(errors, theta, made, start)
    every = np.ones(len(made.rays), dtype=bool)
    solved = Linearised(measured, made.association, poses, places, every)
    system = linearise(solved, errors, theta).reduce()
    told = system.sensitivity[: 3 * len(places)].reshape(-1, 3, len(theta))
    for k, step in enumerate(0.1 * errors.steps):
        ahead, behind = (optimum(errors, theta + s * step * np.eye(len(theta))[k], made, (poses, places)) for s in (1, -1))
        moved = (ahead[1] - behind[1]) / (2 * step)
        assert_allclose(told[..., k], moved, atol=0.01 * np.abs(moved).max() + 1e-5, err_msg=errors.names[k])
        slope = (ahead[2] - behind[2]) / (2 * step)
        assert -system.descent[k] == pytest.approx(slope, abs=0.1 * np.sqrt(system.information[k, k]), rel=0.1)


def test_the_noise_of_the_robot_turns_with_its_camera():
    """Brute force: the slope of the cost by the tilt of a camera, at an odometry whose headings err far more than its noise.

    The noise of a motion belongs to base. As noise in the frame of the camera, a heading that errs would be a roll of the
    robot after a change of the tilt, and a flat floor would make this tilt look known.
    """
    held = "calibration.scale=0", "calibration.turn_scale=0", "calibration.turn_bias=0", "calibration.turn_slip=0"
    turning = Odometry(yaw_per_rad=0.5, yaw_per_m=0.2)
    made, errors = drive({}, overrides=held, frames=200, false=0.0, odometry=turning, pixel_sigma=0.5)
    theta, true = np.zeros(len(errors.names)), made.map_T_base @ made.keyframes.base_T_camera
    start = (made.keyframes.map_T_camera[0] @ inverse(true[0])) @ true, made.points
    poses, places, _, measured = optimum(errors, theta, made, start)
    solved = Linearised(measured, made.association, poses, places, np.ones(len(made.rays), dtype=bool))
    system = linearise(solved, errors, theta).reduce()
    for name in ("front.tilt", "front.roll", "front.yaw"):
        k = errors.names.index(name)
        step = 0.02 * errors.steps[k] * np.eye(len(theta))[k]
        ahead, behind = (optimum(errors, theta + s * step, made, (poses, places))[2] for s in (1, -1))
        slope = (ahead - behind) / (2 * step[k])
        assert -system.descent[k] == pytest.approx(slope, abs=0.02 * np.sqrt(system.information[k, k])), name


@pytest.mark.parametrize("surface", [0.0, 0.5, 1.0])
def test_how_far_centres_are_behind_surfaces_is_found(surface):
    """Without it, the scale of the odometry would take the difference, and all objects would be too near or too far."""
    made, errors = drive({}, depth=DepthNoise(surface=surface))
    found, plain = solve(made, errors), solve(drive({}, depth=DepthNoise(surface=surface))[0], None)
    at = errors.names.index("surface")
    off = found.calibration.values[at] - (surface - 0.5)
    assert found.calibration.sigma[at] < 0.3
    assert abs(off) < 3 * found.calibration.sigma[at]
    miss = found.positions - made.points
    distance2 = np.einsum("ni,ni->n", miss, np.linalg.solve(found.covariance, miss[:, :, None])[:, :, 0])
    assert (distance2 < chi2.ppf(0.999, 3)).all()
    assert plain.calibration is None


@pytest.mark.parametrize(("ranged", "lens"), [(True, {}), (False, {}), (False, {"front.cx": 0.03})])
def test_the_errors_of_a_log_are_found(ranged, lens):
    added = {**ERRORS, **lens}
    made, errors = drive(added, depth=DepthNoise() if ranged else None)
    found, plain = solve(made, errors), solve(made, None)
    true = np.array([added.get(name, 0.0) for name in errors.names])
    deviation = np.abs(found.calibration.values - true) / found.calibration.sigma
    assert (deviation < 4).all(), dict(zip(errors.names, deviation, strict=True))
    told = found.calibration.sigma < 0.5 * np.sqrt(np.diagonal(errors.prior))
    assert {"front.clock", "front.yaw", "front.roll"} <= set(np.array(errors.names)[told])
    # A tilt and an image centre that is too high look the same, so only their difference is known.
    tilt, centre = errors.names.index("front.tilt"), errors.names.index("front.cy")
    both = found.calibration.covariance[np.ix_([tilt, centre], [tilt, centre])]
    assert both.diagonal().min() > 0.2 * errors.prior[tilt, tilt]
    assert both[0, 0] + both[1, 1] - 2 * both[0, 1] < 0.1 * errors.prior[tilt, tilt]
    align = "se2" if ranged else "sim2"
    assert np.median(made.object_errors(found.positions, align)) < 0.7 * np.median(
        made.object_errors(plain.positions, align)
    )


@pytest.mark.parametrize("ranged", [True, False])
def test_slip_in_curves_is_told_apart_from_the_scale(ranged):
    """The odometry is too long in curves alone. Without a correction, the slip bends the map and makes it larger."""
    slip, name = {"odometry.turn_slip": 0.06}, "odometry.turn_slip"
    changes = {"depth": DepthNoise() if ranged else None, "frames": 600, "laps": 4.0}
    made, errors = drive(slip, overrides=("calibration.turn_slip=0.05",), **changes)
    found, held = solve(made, errors), solve(*drive(slip, overrides=("calibration.turn_slip=0",), **changes))
    value, sigma = (dict(zip(errors.names, one, strict=True)) for one in (found.calibration.values, found.calibration.sigma))
    assert abs(value[name] - slip[name]) < 3 * sigma[name]
    assert value[name] > 4 * sigma[name]
    off, bent = (np.median(made.object_errors(one.positions, "sim2")) for one in (found, held))
    assert off < 0.7 * bent
    assert abs(made.scale(found.positions) - 1) < 0.5 * abs(made.scale(held.positions) - 1)


def test_what_bearings_do_not_tell_stays_at_its_prior_and_widens_the_map():
    made, errors = drive(ERRORS, overrides=("calibration.scale=0.05",))
    found, held = solve(made, errors), solve(*drive(ERRORS, overrides=("calibration.scale=0",)))
    k = errors.names.index("odometry.scale")
    assert abs(found.calibration.values[k]) < 0.4 * 0.05
    assert found.calibration.sigma[k] > 0.85 * 0.05
    assert not found.calibration.to_dict()["parameters"]["odometry.scale"]["observable"]
    away = found.positions - made.keyframes.map_T_base[0, :3, 3]
    distance = np.linalg.norm(away, axis=1)
    unit = away / distance[:, None]
    more = np.einsum("ni,nij,nj->n", unit, found.covariance - held.covariance, unit)
    assert_allclose(np.sqrt(more), 0.05 * distance, rtol=0.25, atol=0.02)


def test_two_scales_that_trade_off_are_said():
    made, errors = drive({}, depth=DepthNoise(), overrides=("calibration.scale=0.1", "calibration.range_scale=0.1"))
    assert ("odometry.scale", "range_scale") in solve(made, errors).calibration.traded_off()


def test_without_errors_the_map_is_as_good():
    known = "calibration.surface=0", "depth.centre_sigma=0"  # All simulated surfaces are equally far before the centres.
    made, errors = drive({}, depth=DepthNoise(), overrides=known)
    found, plain = solve(made, errors), solve(made, None)
    assert np.median(made.object_errors(found.positions)) < 1.2 * np.median(made.object_errors(plain.positions)) + 0.01


def test_a_calibration_of_before_is_where_the_next_solve_begins(tmp_path):
    made, errors = drive(ERRORS, depth=DepthNoise())
    first = solve(made, errors).calibration
    (tmp_path / "calibration.yaml").write_text(dump_calibration(first))
    again, known = drive(ERRORS, seed=2, depth=DepthNoise(), overrides=(f"calibration.file={tmp_path}/calibration.yaml",))
    of_robot = [name != "surface" for name in first.names]  # Another place has other things.
    assert_allclose(known.mean, np.where(of_robot, first.values, 0.0))
    second = solve(again, known).calibration
    wider = np.ones(len(first.names)) if second.prior_factor is None else second.prior_factor  # Far from the first estimate.
    assert (second.sigma < first.sigma * wider)[of_robot].all()
    assert (wider > 1.1).sum() <= 1
    true = np.array([ERRORS.get(name, 0.0) for name in second.names])
    assert (np.abs(second.values - true) < 4 * second.sigma).all()


def test_noise_of_odometry_does_not_pull_at_the_scale_of_turns():
    """At the true errors, which are 0, the mean of the gradients of many drives is zero but for its own noise."""
    drives = 12
    pulls = np.zeros(drives)
    for seed in range(drives):
        made, errors = drive({}, seed=seed, depth=DepthNoise(), frames=240, false=0.0)
        theta = np.zeros(len(errors.names))
        true = made.map_T_base @ made.keyframes.base_T_camera
        places, used = made.points, made.right()
        measured = Measurements.of(*errors.at(theta))
        graph = build_graph(measured.factors(made.association.object, np.flatnonzero(used), np.arange(len(places)), places))
        values = levenberg_marquardt(graph, make_values(true, places, np.arange(len(places))), 20, 1e-8).values
        places = with_points(places, np.arange(len(places)), values)
        state = Linearised(measured, made.association, read_poses(values), places, used)
        system = linearise(state, errors, theta).reduce()
        k = errors.names.index("odometry.turn_scale")
        pulls[seed] = system.gradient[k] / np.sqrt(system.information[k, k])
    assert_allclose(pulls.mean(), 0, atol=2.5 / np.sqrt(drives))
    assert pulls.std() < 1.5


def test_errors_that_hang_together_make_the_gradient_less_certain(monkeypatch):
    """White residuals, and residuals that push a parameter the same way for three seconds each."""
    made, errors = drive({}, frames=200, false=0.0)
    theta, every = np.zeros(len(errors.names)), np.ones(len(made.rays), dtype=bool)
    measured = Measurements.of(*errors.at(theta))
    true = made.map_T_base @ made.keyframes.base_T_camera
    state = Linearised(measured, made.association, true, made.points, every)
    system = linearise(state, errors, theta)
    rng, rows = np.random.default_rng(0), np.repeat(made.keyframes.stamps[made.rays.keyframe], 2)
    white = rng.standard_normal(len(system.residual))
    k = errors.names.index("front.yaw")
    assert correlation_factors(state, replace(system, residual=white))[k] < 1.4
    stamps = made.keyframes.stamps
    window = np.floor((rows - stamps[0]) / correlation_time(stamps)).astype(int)
    pushes = system.sides[:, k] + system.jacobian @ system.reduce().sensitivity[:, k]  # what poses and places leave of it
    together = white.copy()
    together[: len(rows)] = rng.standard_normal(window.max() + 1)[window] * np.sign(pushes[: len(rows)])
    assert correlation_factors(state, replace(system, residual=together))[k] > 1.5
    # The boxes of one object err together for the whole log, and each window has boxes of several objects.
    landmark, side = np.repeat(made.association.object, 2), np.sign(pushes[: len(rows)])
    alone = white.copy()
    alone[: len(rows)] = rng.standard_normal(landmark.max() + 1)[landmark] * side
    assert correlation_factors(state, replace(system, residual=alone))[k] > 1.5
    both = correlation_factors(state, replace(system, residual=alone))[k]
    monkeypatch.setattr(correlated_errors, "_by_object", lambda of, system, window: window)
    assert both > 1.1 * correlation_factors(state, replace(system, residual=alone))[k]


@pytest.mark.parametrize("clock", [0.0, 0.07])
def test_a_circle_at_one_speed_tells_no_clock_and_no_share_of_scale_and_bias(clock):
    """The turns that the odometry measured too long or too short in all are one number, which landmarks tell exactly.

    How much of it is a scale, and how much a bias, is unknown: both stay at their priors in proportion. So is the clock.
    """
    log = circle_log(0, 700, clock, turn_noise=0.008)
    made = drive_of(log, load_settings(None, ("mode=joint",)))
    errors = shared_errors(log, made.keyframes, made.rays, made.settings)
    found = solve(made, errors).calibration
    value, sigma = (dict(zip(found.names, one, strict=True)) for one in (found.values, found.sigma))
    turn = np.unwrap(np.arctan2(log.odometry.poses[:, 1, 0], log.odometry.poses[:, 0, 0]))
    rate = 0.5 / 4.0
    too_long = (turn[-1] - turn[0]) / (rate * (log.odometry.stamps[-1] - log.odometry.stamps[0])) - 1
    assert value["odometry.turn_scale"] + value["odometry.turn_bias"] / rate == pytest.approx(-too_long, abs=0.005)
    assert abs(value["odometry.turn_bias"]) < 0.5e-3  # Half of the prior's sigma.
    assert sigma["odometry.turn_bias"] > 0.9e-3
    assert abs(value["front.clock"]) < 3 * sigma["front.clock"]
    assert abs(value["front.clock"]) < 0.05  # The noise of the odometry would move it to its bound, 0.5 s.


def test_only_measured_motions_have_noise_in_their_derivatives():
    """Commands are smooth: what the robot did differently is in the residuals, but not in the odometry."""
    shares = []
    for commanded in (False, True):
        log = circle_log(0, 200, 0.0, turn_noise=0.008, commanded=commanded)
        made = drive_of(log, load_settings(None, ("mode=joint",)))
        errors = shared_errors(log, made.keyframes, made.rays, made.settings)
        theta, start = np.zeros(len(errors.names)), (made.map_T_base @ made.keyframes.base_T_camera, made.points)
        poses, places, _, measured = optimum(errors, theta, made, start)
        state = Linearised(measured, made.association, poses, places, np.ones(len(made.rays), dtype=bool))
        k = errors.names.index("front.clock")
        shares.append(noise_shares(state, linearise(state, errors, theta), errors)[k, k])
    assert shares[0] > 0.5
    assert shares[1] < 0.01


def test_below_ties_the_path_is_the_instrument_of_the_clock():
    """Images come every 0.2 s, and poses of the odometry every 1.4 s, or as often as the images."""
    found = {}
    for every in (1, 7):
        log = simulate(preset("demo", frames=200, objects=12, classes=12, localization=None, odometry=Odometry()), 3)
        log = replace(log, odometry=Trajectory(log.odometry.stamps[::every], log.odometry.poses[::every]))
        made = drive_of(log, load_settings(None, ("mode=joint", "poses.max_gap=2")))
        errors, every_ray = shared_errors(log, made.keyframes, made.rays, made.settings), np.ones(len(made.rays), dtype=bool)
        theta, poses = np.zeros(len(errors.names)), made.map_T_base @ made.keyframes.base_T_camera
        measured = Measurements.of(*errors.at(theta))
        state = Linearised(measured, made.association, poses, made.points, every_ray)
        system = linearise(state, errors, theta)
        k = errors.names.index("front.clock")
        found[every] = noise_shares(state, system, errors)[k, k], measured.motions.tied
    assert found[1][1] == 0
    assert 0.2 < found[7][1] <= found[7][0] <= 1


@pytest.mark.parametrize("axes", [[0], [0, 1]])
def test_noise_of_rays_asks_for_no_error(axes):
    """At the true poses and points, the gradient is noise, also if only one image axis has noise, as that of a laser does.

    All rays are in one half of the image. Derivatives at the measured rays would contain the noise of the rays. The step to
    the optimum would then be 8 standard deviations for the centre of the image, and 5 for the offset of the ranges.
    """
    more = ("calibration.focal=0.02", "calibration.centre=0.02", "calibration.range_offset=0.05")
    made, errors = drive({}, overrides=more, frames=1500, false=0.0, pixel_sigma=0.01, depth=DepthNoise())
    theta, true = np.zeros(len(errors.names)), made.map_T_base @ made.keyframes.base_T_camera
    points = made.points[made.association.object][..., None]
    camera_T_map = np.linalg.inv(true)[made.rays.keyframe]
    to = (camera_T_map[:, :3, :3] @ points)[..., 0] + camera_T_map[:, :3, 3]
    left, rng = to[:, 0] < 0, np.random.default_rng(0)
    image, away = to / to[:, 2:], np.linalg.norm(to, axis=1)
    image[:, axes] += 0.1 * rng.normal(size=(len(to), len(axes)))
    noisy = replace(
        made.rays,
        direction=image / np.linalg.norm(image, axis=1)[:, None],
        sigma=0.1 * (to[:, 2] / away) ** 1.5,  # The same noise in the image, as the mean over both axes.
        range=away * (1 + 0.1 * rng.normal(size=len(to))),
        range_sigma=0.1 * away,
    )
    errors = errors.take(errors.keyframes, noisy)
    state = Linearised(Measurements.of(*errors.at(theta)), made.association, true, made.points, left)
    system = linearise(state, errors, theta)
    lens = np.array(
        [errors.names.index(name) for name in ("front.yaw", "front.focal", "front.cx", "front.cy", "range_offset")]
    )
    reduced = system.reduce().take(lens)
    off = np.linalg.solve(reduced.information, reduced.descent) / np.sqrt(np.diagonal(np.linalg.inv(reduced.information)))
    assert np.abs(off).max() < 3.5, off


@pytest.mark.parametrize("localized", [False, True])
def test_only_what_a_parameter_changes_is_measured_again(monkeypatch, localized):
    """The centre of a lens turns bearings, and moves neither poses nor ranges. So the other rows have no derivative."""
    place = {"localization": PoseNoise()} if localized else {}
    made, errors = drive({}, overrides=("calibration.centre=0.02",), frames=200, false=0.0, depth=DepthNoise(), **place)
    theta, every = np.zeros(len(errors.names)), np.ones(len(made.rays), dtype=bool)
    measured, made_of, part = Measurements.of(*errors.at(theta)), [], parameter_columns._Part
    state = Linearised(measured, made.association, made.map_T_base @ made.keyframes.base_T_camera, made.points, every)

    def counted(first, inputs, measured, residuals):
        return part(first, inputs, lambda *given: made_of.append(first) or measured(*given), residuals)

    monkeypatch.setattr(parameter_columns, "_Part", counted)
    sides, _, _ = parameter_columns.parameter_columns(state, errors, theta)
    mounts = {f"front.{name}" for name in ("roll", "tilt", "yaw", "x", "y", "z")}
    poses = sum(name.startswith("odometry.") or name in mounts for name in errors.names)
    first = state.graph.first_motion
    assert made_of.count(first) == 1 + poses + 2  # Here, at each of these errors, and at both sides of the clock.
    lengths = {"range_scale", "range_offset", "surface"} & set(errors.names)
    assert made_of.count(state.graph.first_range) == 1 + len(lengths)
    for name in ("front.cx", "front.cy", "range_scale"):
        of = sides[:, errors.names.index(name)]
        assert of[:first].any()
        assert not of[first:].any()


@pytest.mark.parametrize("localized", [False, True])
def test_products_with_instruments_need_no_columns(localized):
    """A clock whose images are half of all, against the product with the columns themselves."""
    place = {"localization": PoseNoise()} if localized else {}
    made, errors = drive({}, frames=200, false=0.0, **place)
    theta, every = np.zeros(len(errors.names)), np.ones(len(made.rays), dtype=bool)
    measured = Measurements.of(*errors.at(theta))
    true = made.map_T_base @ made.keyframes.base_T_camera
    system = linearise(Linearised(measured, made.association, true, made.points, every), errors, theta)
    k, rng = errors.names.index("front.clock"), np.random.default_rng(0)
    some = {k: np.arange(len(made.keyframes)) % 2 == 0}
    clocks, columns = replace(system.clocks, moved=some), np.zeros((len(system.residual), 5))
    velocity, residual = rng.normal(size=(len(made.keyframes), 6, 5)), rng.normal(size=len(system.residual))
    clocks.put(columns, k, velocity)
    np.testing.assert_allclose(clocks.products(residual, k, velocity), residual @ columns, rtol=1e-9)
    if system.motions is not None:
        back = system.motions.to_rows @ system.motions.to_twist
        np.testing.assert_allclose(back, np.broadcast_to(np.eye(6), back.shape), atol=1e-6)


def test_a_noise_with_which_most_rays_disagree_is_refused(monkeypatch):
    """The rays of things that move can make the estimated noise smaller and smaller, until few rays agree."""
    made, errors = drive({}, frames=150)
    monkeypatch.setattr(self_calibration, "estimate_noise", lambda *_: NoiseFactors(rays=0.02))
    found = solve(made, errors)
    assert found.noise == errors.noise
    assert (found.weight > 0).mean() > 0.7
