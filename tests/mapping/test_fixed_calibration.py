"""Fixed mode with calibration: the cameras against the localisation, on simulated drives whose errors are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from added_errors import add_shared_errors
from numpy.testing import assert_allclose

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.io.calibration_yaml import dump_calibration
from objslam.mapping import pipeline
from objslam.mapping.fixed.fixed_poses import FixedPoses
from objslam.simulation import make_camera, preset, simulate

SEEDS = range(3)
HELD = "calibration.use=false"


@cache
def drive(seed: int, wrong: bool) -> tuple[Log, dict[str, float]]:
    """A drive of 250 frames with localisation, and the errors drawn for it."""
    rng = np.random.default_rng(seed)
    sigmas = {"clock": 0.1, "yaw": np.radians(2), "tilt": np.radians(1)}
    errors = {f"front.{kind}": float(sigma * rng.standard_normal()) for kind, sigma in sigmas.items()}
    log = simulate(preset("demo", odometry=None, frames=250), seed)
    return (add_shared_errors(log, errors), errors) if wrong else (log, {})


def run(log: Log, *overrides: str, ledger: Ledger | None = None) -> RunResult:
    settings = load_settings(
        None, ("mode=fixed", "output.recording=false", "checks.use=false", "bodies.use=false", *overrides)
    )
    return pipeline.run(log, settings, ledger or Ledger())


def off(log: Log, result: RunResult) -> list[tuple[float, float]]:
    """For each true object the distance (m) of the nearest object of its label, and its squared Mahalanobis distance."""
    found = []
    assert log.truth is not None
    for true in log.truth.objects:
        mine = [o for o in result.map.resolved() if o.label == true.label]
        near = min(mine, key=lambda o: float(np.linalg.norm(o.position - true.position)))
        miss = near.position - true.position
        found.append((float(np.linalg.norm(miss)), float(miss @ np.linalg.solve(near.covariance, miss))))
    return found


def rms(distances: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(distances))))


@cache
def estimated(seed: int, wrong: bool) -> RunResult:
    return run(drive(seed, wrong)[0])


@cache
def held(seed: int, wrong: bool) -> RunResult:
    return run(drive(seed, wrong)[0], HELD)


def test_the_errors_that_were_put_in_are_found():
    for seed in SEEDS:
        found = estimated(seed, True).calibration
        true = np.array([drive(seed, True)[1].get(name, 0.0) for name in found.names])
        assert (np.abs(found.values - true) < 3 * found.sigma).all(), (seed, found.values - true, found.sigma)
        known = np.isin([name.rpartition(".")[2] for name in found.names], ("clock", "roll", "yaw"))
        assert (found.sigma[known] < 0.3 * found.prior[known]).all()
        assert ("front.tilt", "front.cy") in found.traded_off()


def test_the_objects_are_as_good_as_with_known_errors():
    known, found, left = [], [], []
    inside = []
    for seed in SEEDS:
        clean = drive(seed, False)[0]
        known += [d for d, _ in off(clean, held(seed, False))]
        found += [d for d, _ in off(clean, estimated(seed, True))]
        inside += [m < 7.815 for _, m in off(clean, estimated(seed, True))]  # 95 % of chi-squared with 3 degrees of freedom
        left += [d for d, _ in off(clean, held(seed, True))]
    assert rms(found) < 1.3 * rms(known)
    assert rms(found) < 0.2 * rms(left)
    assert np.mean(inside) > 0.9


def test_without_errors_the_objects_are_not_worse():
    ratios = []
    for seed in SEEDS:
        clean = drive(seed, False)[0]
        found, known = ([d for d, _ in off(clean, made(seed, False))] for made in (estimated, held))
        ratios.append(rms(found) / rms(known))
    assert np.median(ratios) < 1.05


def test_the_result_is_that_of_the_corrected_log():
    """What a run finds is in its summary and its recording, and a run that is given it maps the same without estimating."""
    log, _ = drive(1, True)
    result = run(log, "output.recording=true")
    found = result.calibration
    parameters = result.summary["calibration"]["parameters"]
    assert [parameters[name]["value"] for name in found.names] == found.values.tolist()
    assert result.keyframes.stamps[0] == pytest.approx(
        log.cameras[0].detections.frame_stamps[result.keyframes.frame[0]] + found.values[0]
    )
    assert result.residual_before is not None
    assert np.nanmedian(result.residual_before) > 1.5 * np.nanmedian(result.residual)
    steps = [step.parameters for one in result.trace for step in one.iterations if step.parameters is not None]
    assert_allclose(steps[0].values, 0.0)
    assert_allclose(steps[-1].values, found.values)
    assert len(result.trace) == len(result.summary["rounds"]) + 1


def test_a_run_that_is_given_the_calibration_maps_the_same(tmp_path):
    log, _ = drive(1, True)
    first = estimated(1, True)
    (tmp_path / "robot.yaml").write_text(dump_calibration(first.calibration))
    known = run(log, HELD, f"calibration.file={tmp_path}/robot.yaml")
    assert known.calibration is None
    clean = drive(1, False)[0]
    assert rms([d for d, _ in off(clean, known)]) < 1.1 * rms([d for d, _ in off(clean, first)]) + 1e-3
    again = run(log, f"calibration.file={tmp_path}/robot.yaml").calibration
    assert_allclose(again.expected, first.calibration.values)
    assert (again.sigma < first.calibration.sigma).all()


def test_plain_odometry_calibrates_nothing_and_says_so():
    log = simulate(preset("demo", localization=None, odometry=Odometry(), frames=150), 1)
    ledger = Ledger()
    assert run(log, "calibration.use=true", ledger=ledger).calibration is None
    assert any("plain odometry and allow no calibration" in warning for warning in ledger.warnings)


def test_each_of_two_cameras_has_its_own_errors():
    cameras = (make_camera("front"), make_camera("left", yaw=np.pi / 2))
    log = simulate(preset("demo", odometry=None, frames=200, cameras=cameras), 3)
    errors = {"front.yaw": 0.03, "left.yaw": -0.02, "left.clock": -0.08}
    found = run(add_shared_errors(log, errors)).calibration
    true = np.array([errors.get(name, 0.0) for name in found.names])
    assert (np.abs(found.values - true) < 3 * found.sigma).all()
    assert len(found.names) == 20


def test_where_no_object_is_placed_the_errors_stay_at_their_prior():
    log, _ = drive(0, False)
    one = log.cameras[0]
    few = replace(log, cameras=(replace(one, detections=one.detections.take(np.arange(4))),))
    ledger = Ledger()
    result = run(few, ledger=ledger)
    assert_allclose(result.calibration.values, 0.0)
    assert any("shared errors could not be estimated" in warning for warning in ledger.warnings)


def test_a_camera_that_is_the_base_is_not_turned():
    """The poses of a log whose base_T_camera is the identity are the camera's own, so that nothing can be turned."""
    log = simulate(preset("demo", odometry=None, frames=200), 3)
    one = log.cameras[0]
    poses = log.localization.poses @ one.camera.base_T_camera
    own = replace(log.localization, poses=poses)
    camera = replace(one.camera, base_T_camera=np.eye(4))
    log = replace(log, localization=own, cameras=(replace(one, camera=camera),))
    assert run(log).calibration.names == ("front.clock",)
    assert len(run(log, "calibration.use=true").calibration.names) == 10


def test_small_errors_do_not_hide_the_objects_of_a_short_drive():
    """What a rotation and a clock can be is far more than the noise of a ray: nothing can be told apart within it."""
    changes = {"objects": 23, "classes": 3, "min_view_share": 0.01, "min_parallax_deg": 5.0, "pixel_sigma": 1.0}
    log = simulate(preset("demo", odometry=None, frames=60, frame_rate=10.0, **changes), 118)
    held, found = run(log, HELD), run(log)
    assert len(held.map.resolved()) > 10
    assert len(found.map.resolved()) > 0.8 * len(held.map.resolved())


def test_errors_that_settle_slowly_are_settled_from_the_objects_that_there_are(monkeypatch):
    """A clock that is off by 0.4 s takes several rounds. The first ones and one more search among all rays. All others begin
    with the objects of the round before."""
    searched, associate = [], FixedPoses.associate

    def noted(self, more=0.0, guess=None):
        searched.append(guess is None)
        return associate(self, more, guess)

    monkeypatch.setattr(FixedPoses, "associate", noted)
    log, _ = drive(1, wrong=False)
    late = add_shared_errors(log, {"front.clock": 0.4})
    result = run(late, "calibration.clock=1")
    found = result.calibration
    assert found is not None
    at = found.names.index("front.clock")
    assert abs(found.values[at] - 0.4) < 0.02
    assert rms([distance for distance, _ in off(log, result)]) < 0.05
    first = searched.index(False)
    assert searched[:first] == [True] * first
    assert searched[first:].count(True) == 1
    assert searched.count(False) >= 2
