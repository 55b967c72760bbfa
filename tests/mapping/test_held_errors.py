"""Gross errors of a camera that joint mode holds are found in the map, and usual ones stay held."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from added_errors import add_shared_errors
from quick import NOTHING_DRAWN
from test_moved_camera import turned

from objslam.config import Odometry, load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.corrected_odometry import CorrectablePath
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.io.calibration_yaml import dump_calibration
from objslam.mapping import pipeline
from objslam.mapping.alternation import solve
from objslam.mapping.joint.held_errors import Solved, check_turned_camera, with_gross_errors, with_held_errors
from objslam.mapping.solution import seen_something
from objslam.output.viewer.recording import write_recording
from objslam.simulation import DepthNoise, preset, simulate

SETTINGS = (*NOTHING_DRAWN, "mode=joint", "bodies.use=false")


@cache
def drive(seed: int) -> Log:
    """A drive from odometry alone, with one label for each object."""
    room = {"objects": 10, "classes": 10, "pixel_sigma": 2.0, "missed": 0.1, "false": 0.01, "frames": 300}
    return simulate(preset("demo", **room, odometry=Odometry(), localization=None), seed)


def run(log: Log, *more: str):
    ledger = Ledger()
    return pipeline.run(log, load_settings(None, (*SETTINGS, *more)), ledger), ledger


@cache
def plain(*more: str):
    """A run of a drive without shared errors."""
    return run(drive(0), *more)


@cache
def with_gross(name: str, value: float):
    """The log of a drive with a gross error, and its run, which keeps the steps of the solver for a recording."""
    log = add_shared_errors(drive(3), {name: value})
    return log, *run(log, "output.recording=true")


GROSS = [("front.y", -0.2), ("front.x", 0.25), ("front.focal", 0.1), ("front.focal", -0.1)]


@pytest.mark.parametrize(("name", "value"), GROSS)
def test_a_gross_error_is_estimated_and_named(name, value):
    log, result, ledger = with_gross(name, value)
    found = result.calibration
    at = found.names.index(name)
    assert abs(found.values[at]) > 0.7 * abs(value)
    assert np.sign(found.values[at]) == np.sign(value)
    assert any(f"the shared error {name} is" in warning for warning in ledger.warnings)
    matches = evaluate(result.map, log.truth, align="se2", radius=1.0).objects.matches
    assert len(matches) == 10
    assert max(match.squared_3d for match in matches) < 13.9


def test_wheels_of_two_sizes_are_found_and_named():
    """The turn rate that stands in for them is wrong where the robot slows down. Names are said to be names: where a search
    without them would begin is not asked here."""
    room = {"objects": 12, "classes": 12, "frames": 300, "room": (14.0, 10.0), "laps": 2.0, "depth": DepthNoise()}
    clean = simulate(preset("demo", **room, odometry=Odometry(), localization=None), 3)
    result, ledger = run(add_shared_errors(clean, {"odometry.turn_per_m": 0.05}), "association.method=by_label")
    found = dict(zip(result.calibration.names, result.calibration.values.tolist(), strict=True))
    assert found["odometry.turn_per_m"] == pytest.approx(0.05, abs=0.01)
    assert any("the shared error odometry.turn_per_m is" in warning for warning in ledger.warnings)
    matches = evaluate(result.map, clean.truth, align="se2", radius=1.0).objects.matches
    assert len(matches) == 12
    assert max(match.squared_3d for match in matches) < 13.9


@pytest.mark.parametrize(
    "errors",
    [{}, {"front.y": 0.05, "front.x": -0.05}, {"front.focal": 0.02, "front.cx": 0.04}, {"odometry.turn_per_m": 0.01}],
)
def test_usual_errors_stay_held(errors):
    result, ledger = run(add_shared_errors(drive(0), errors)) if errors else plain()
    assert {"front.x", "front.y", "front.focal", "odometry.turn_per_m"}.isdisjoint(result.calibration.names)
    assert not any("moved the camera" in warning for warning in ledger.warnings)


@pytest.mark.parametrize("value", [-0.055, 0.055])
def test_the_sigmas_contain_a_focal_length_that_stays_held(value):
    """It is 2.7 usual standard deviations off, so it is not gross. A user may say that the lens is exact."""
    log, over = add_shared_errors(drive(2), {"front.focal": value}), []
    for more in ((), ("calibration.focal=0",)):
        result, _ = run(log, *more)
        assert "front.focal" not in result.calibration.names
        matches = evaluate(result.map, log.truth, align="se2", radius=1.0).objects.matches
        assert len(matches) == 10
        over.append(sum(match.squared_3d > 13.9 for match in matches))
    assert over[0] == 0
    assert over[1] > 0


@pytest.mark.parametrize("height", [-0.09, 0.09])
def test_the_sigmas_contain_a_wrong_height_of_the_camera(height):
    """The robot drives on a plane, so all objects are wrong by the same height. A user may say that the height is exact."""
    log, far = add_shared_errors(drive(2), {"front.z": height}), []
    for more in ((), ("calibration.translation=0",)):
        result, _ = run(log, *more)
        assert "front.z" not in result.calibration.names
        matches = evaluate(result.map, drive(2).truth, align="se2", radius=1.0).objects.matches
        assert len(matches) == 10
        assert max(match.squared_3d for match in matches) < 13.9  # The alignment moves the map down.
        height_of = {one.label: one.position[2] for one in drive(2).truth.objects}
        errors = [(one.position[2] - height_of[one.label]) / np.sqrt(one.covariance[2, 2]) for one in result.map.resolved()]
        far.append(sum(np.abs(errors) > 2.5))
    assert far[0] == 0
    assert far[1] >= 5


def test_objects_of_one_camera_share_the_error_of_its_height():
    """The height of one object tells the heights of the others. With two cameras, each object has the error of the cameras
    that saw it, by the share of their rays."""
    solution = plainly_solved()
    whole = with_held_errors(solution.errors, solution, Ledger()).estimate
    lifted = whole.correlated[:, :, -1]
    np.testing.assert_allclose(lifted, np.tile([0, 0, 0.05], (len(lifted), 1)), atol=1e-12)
    camera = (solution.keyframes.stamps > np.median(solution.keyframes.stamps)).astype(np.int64)
    errors, keyframes = solution.errors, replace(solution.errors.keyframes, camera=camera)
    one = errors.log.cameras[0]
    rear = replace(one, camera=replace(one.camera, name="rear"))
    two = replace(errors, keyframes=keyframes, log=replace(errors.log, cameras=(one, rear)))
    lifted = with_held_errors(two, solution, Ledger()).estimate.correlated[:, 2, -2:]
    rays = solution.errors.rays
    for of in range(solution.association.count):
        own = solution.association.object == of
        late = np.average(camera[rays.keyframe[own]], weights=solution.estimate.weight[own])
        np.testing.assert_allclose(lifted[of], [0.05 * (1 - late), 0.05 * late], atol=1e-12)


def test_a_camera_that_is_the_base_has_no_height():
    solution = plainly_solved()
    (one,) = solution.errors.log.cameras
    itself = replace(one, camera=replace(one.camera, base_T_camera=np.eye(4)))
    errors = replace(solution.errors, log=replace(solution.errors.log, cameras=(itself,)))
    before = with_held_errors(solution.errors, solution, Ledger()).estimate
    after = with_held_errors(errors, solution, Ledger()).estimate
    assert np.allclose(before.covariance[:, 2, 2] - after.covariance[:, 2, 2], 0.05**2)


def test_the_sigmas_of_a_right_camera_hardly_grow():
    sigma = []
    for more in ((), ("calibration.focal=0",)):
        objects = plain(*more)[0].map.resolved()
        sigma.append(np.median([np.sqrt(np.linalg.eigvalsh(one.covariance)[-1]) for one in objects]))
    assert 1.0 < sigma[0] / sigma[1] < 1.2


def test_sigmas_without_the_held_focal_length_are_named(monkeypatch):
    from objslam.graph.calibration.next_step import NextStep

    def fails(*_):
        raise SolveError("not finite")

    monkeypatch.setattr(NextStep, "moved_by", fails)
    result, ledger = run(drive(0))
    assert len(result.map.resolved()) == 10
    assert [one for one in ledger.warnings if "sigmas lack the usual error of a focal length" in one] != []


def test_the_step_that_finds_no_gross_error_tells_what_the_held_errors_do(monkeypatch):
    """It has the numbers of a step of the focal length alone, and needs no corrected path of its own."""
    from objslam.graph.calibration.next_step import NextStep

    solution = plainly_solved()
    assert solution.estimate.moved_by_held is not None
    steps, paths, of, init = [], [], NextStep.of, CorrectablePath.__init__
    monkeypatch.setattr(NextStep, "of", lambda *given: steps.append(given) or of(*given))
    monkeypatch.setattr(CorrectablePath, "__init__", lambda *given: paths.append(given) or init(*given))
    at_once = with_held_errors(solution.errors, solution, Ledger())
    assert steps == []
    alone = replace(solution, estimate=replace(solution.estimate, moved_by_held=None))
    again = with_held_errors(solution.errors, alone, Ledger())
    assert check_turned_camera(solution.errors, solution) == []
    assert (len(steps), len(paths)) == (2, 0)
    assert (np.trace(at_once.estimate.covariance - solution.estimate.covariance, axis1=1, axis2=2) > 0).all()
    np.testing.assert_allclose(at_once.estimate.covariance, again.estimate.covariance, rtol=1e-9)
    np.testing.assert_allclose(at_once.estimate.correlated, again.estimate.correlated, rtol=1e-6, atol=1e-9)


def test_a_step_of_some_errors_needs_the_others_at_zero():
    from objslam.graph.calibration.next_step import NextStep

    solution = plainly_solved()
    errors, theta = solution.errors, solution.estimate.calibration.values
    step = NextStep.of(errors, solution.association, solution.estimate, theta)
    left_out = int(np.argmax(np.abs(theta)))
    kept = np.delete(np.arange(len(theta)), left_out)
    names = tuple(errors.names[k] for k in kept.tolist())
    some = replace(errors, names=names, mean=errors.mean[kept], prior=errors.prior[np.ix_(kept, kept)])
    assert step.only(some) is None
    zero = replace(step, theta=np.where(np.arange(len(theta)) == left_out, 0.0, theta)).only(some)
    np.testing.assert_array_equal(zero.theta, theta[kept])
    np.testing.assert_array_equal(zero.reduced.gradient, step.reduced.gradient[kept])


def test_a_held_focal_length_moves_the_map_as_solves_with_other_ones_do(monkeypatch):
    """The solves converge, and their estimated errors follow the focal length."""
    from objslam.graph.batch_solver import solve_joint
    from objslam.graph.calibration import self_calibration
    from objslam.graph.calibration.next_step import NextStep

    monkeypatch.setattr(self_calibration, "_CONVERGED", 1e-3)
    monkeypatch.setattr(self_calibration, "_ROUNDS", 30)

    wrong, positions = 0.005, []
    solution, settings = solved(drive(0), "noise.rays=false", "noise.odometry=false")
    for value in (wrong, -wrong):
        log = add_shared_errors(drive(0), {"front.focal": value})
        frames = build_keyframes(log, settings, Ledger())
        measured = seen_something(frames, build_rays(log, frames, settings, Ledger()))
        errors = shared_errors(log, *measured, settings)
        start = solution.estimate.map_T_base @ solution.keyframes.base_T_camera
        given = *measured, solution.association, settings, Ledger()
        held = solve_joint(*given, start=start, errors=errors, theta=solution.estimate.calibration.values)
        positions.append(held.positions)
    expected = (positions[0] - positions[1]) / (2 * wrong)

    of = settings.calibration.model_copy(update={"focal": 0.02})
    wider = solution.errors.settings.model_copy(update={"calibration": of})
    errors = shared_errors(solution.errors.log, solution.errors.keyframes, solution.errors.rays, wider)
    at = np.array([name == "front.focal" for name in errors.names])
    theta = np.zeros(len(at))
    theta[~at] = solution.estimate.calibration.values
    step = NextStep.of(errors, solution.association, solution.estimate, theta)
    usual = np.hypot(0.02, step.predicted().values[at])
    moved = step.moved_by(at)[:, :, 0] / usual
    assert np.linalg.norm(expected) > 1.0  # Metres for each unit of the error.
    assert np.linalg.norm(moved + expected) < 0.18 * np.linalg.norm(expected)  # 0.23 if they did not follow.


@cache
def plainly_solved():
    """The solution of a drive without shared errors."""
    return solved(drive(0))[0]


def solved(log: Log, *more: str):
    """The solution and the settings of a drive."""
    settings = load_settings(None, (*SETTINGS, *more))
    frames = build_keyframes(log, settings, Ledger())
    rays = build_rays(log, frames, settings, Ledger())
    errors = shared_errors(log, *seen_something(frames, rays), settings)
    cameras = tuple(one.camera for one in log.cameras)
    return solve(frames, rays, cameras, settings, Ledger(), lambda *_: None, errors=errors), settings


def test_a_setting_of_the_user_is_kept():
    solution, settings = solved(add_shared_errors(drive(0), {"front.y": -0.2}), "calibration.translation=0")
    errors = solution.errors
    found = Solved(solution.association, solution.estimate, solution.keyframes)
    assert with_gross_errors(errors, found)[0] is None
    other = settings.model_copy(update={"calibration": settings.calibration.model_copy(update={"translation": "auto"})})
    wider, _ = with_gross_errors(replace(errors, settings=other), found)
    assert set(wider.names) - set(errors.names) == {"front.x", "front.y", "front.z"}


def test_errors_of_a_calibration_file_are_neither_gross_nor_a_turn(tmp_path):
    """The log is corrected by them before the solve, so the map must not show them a second time."""
    true = {"front.clock": 0.15, "front.yaw": 0.03, "front.x": 0.06, "front.y": -0.05, "front.focal": 0.03}
    sigma = np.array([0.005, 0.003, 0.008, 0.008, 0.003])
    known = Calibration(tuple(true), np.array(list(true.values())), np.diag(sigma**2), 5 * sigma)
    (tmp_path / "robot.yaml").write_text(dump_calibration(known))
    log = add_shared_errors(drive(0), true)
    result, _ = run(log, f"calibration.file={tmp_path}/robot.yaml")
    assert {"front.x", "front.y", "front.focal"}.isdisjoint(result.calibration.names)
    assert not any(one["name"] == "camera moved" for one in result.summary["wrong_input"])
    matches = evaluate(result.map, log.truth, align="se2", radius=1.0).objects.matches
    assert max(match.squared_3d for match in matches) < 7.8


def test_the_recording_has_the_errors_of_both_solves(tmp_path):
    """The first solve holds the place of the camera, so it has fewer errors than the last one."""
    log, result, _ = with_gross(*GROSS[0])
    steps = [step.parameters.names for one in result.trace for step in one.iterations if step.parameters is not None]
    assert len(set(map(len, steps))) == 2
    write_recording(result, tmp_path / "recording.rrd", log.truth)
    assert (tmp_path / "recording.rrd").stat().st_size > 1000


@pytest.mark.parametrize(("axis", "name"), [(0, "roll"), (1, "tilt"), (2, "yaw")])
def test_a_camera_that_was_turned_in_the_middle_spoils_the_map(axis, name):
    result, _ = run(turned(drive(0), axis, 8.0))
    (found,) = [one for one in result.summary["wrong_input"] if one["name"] == "camera moved"]
    assert f"front.{name} changes by" in found["message"]
    assert result.map.resolved() == ()


def test_an_odometry_that_turns_in_the_middle_is_no_turned_camera():
    """The robot turns as well, so it drives where its camera looks."""
    log = drive(0)
    path = log.odometry
    middle = path.poses[len(path) // 2]
    jump = middle @ lift_se2(np.array([0.0, 0.0, np.radians(10.0)])) @ inverse(middle)
    late = (np.arange(len(path)) > len(path) // 2)[:, None, None]
    result, _ = run(replace(log, odometry=Trajectory(path.stamps, np.where(late, jump @ path.poses, path.poses))))
    assert not any(one["name"] == "camera moved" for one in result.summary["wrong_input"])


def test_a_step_from_an_optimum_stays_there():
    from objslam.graph.calibration.next_step import NextStep

    solution, _ = solved(add_shared_errors(drive(0), {"front.yaw": 0.03, "front.clock": 0.1}))
    errors = solution.errors
    found = solution.estimate.calibration
    like = errors.with_noise(solution.estimate.noise)
    again = NextStep.of(like, solution.association, solution.estimate, found.values).predicted()
    assert np.abs((again.values - found.values) / found.sigma).max() < 0.25
    assert (again.sigma < 1.1 * found.sigma).all()
    assert (again.sigma > 0.3 * found.sigma).all()
