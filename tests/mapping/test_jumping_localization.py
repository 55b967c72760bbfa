"""Maps at poses of a localisation that jumps once: errors, sigmas, the camera's mount and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lasting_localization import with_lasting

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.maps.shared_covariance import jacobian
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.localization.localization_jumps import find_jumps
from objslam.mapping import pipeline
from objslam.mapping.checks.jumps import wrong_jumps
from objslam.mapping.fixed.lasting_errors import LASTING
from objslam.simulation import PoseNoise, preset, simulate


def jumping(seed: int, early: bool) -> Log:
    """A drive whose localisation is 0.25 m off before, or after, the middle. Beside this it errs as the settings say."""
    noise = {"localization": PoseNoise(xy=0.008, yaw=0.0016), "pixel_sigma": 2.0}
    log = simulate(preset("demo", odometry=None, objects=12, classes=12, frames=300, false=0.0, **noise), seed)
    log = with_lasting(log, 1.0, 3.0, seed)
    path = log.localization
    assert path is not None
    poses = path.poses.copy()
    poses[(path.stamps < np.median(path.stamps)) == early, :2, 3] += [0.15, 0.2]
    return replace(log, localization=replace(path, poses=poses))


def mapped(log: Log, jumps: str) -> pipeline.RunResult:
    settings = load_settings(None, ("mode=fixed", "output.recording=false", "bodies.use=false", f"poses.jumps={jumps}"))
    return pipeline.run(log, settings, Ledger())


def misses(result: pipeline.RunResult, log: Log) -> tuple[list[np.ndarray], list[float]]:
    """Return the errors, m, and the squared Mahalanobis distances of the objects."""
    assert log.truth is not None
    place = {item.label: item.position for item in log.truth.objects}
    off = [(item.position - place[item.label], item.covariance) for item in result.map.resolved()]
    return [miss for miss, _ in off], [float(miss @ np.linalg.solve(covariance, miss)) for miss, covariance in off]


def test_the_sigmas_contain_a_jump_and_the_map_is_not_bent() -> None:
    inside = []
    for seed, early in ((0, False), (1, True)):
        log = jumping(seed, early)
        bent, _ = misses(mapped(log, "keep"), log)
        result = mapped(log, "correct")
        errors, squares = misses(result, log)
        inside += [square < 7.81 for square in squares]  # The 95 % quantile of chi-squared.
        # All objects are off together, by half of the jump.
        assert np.std(errors, axis=0)[:2].max() < 0.06
        assert np.std(bent, axis=0)[:2].max() > 1.5 * np.std(errors, axis=0)[:2].max()
        np.testing.assert_allclose(np.abs(np.mean(errors, axis=0))[:2], [0.075, 0.1], atol=0.05)
        # The other errors last for 3 s and are as large as all errors should be, which may be said too, as without a jump.
        first, *others = [one["name"] for one in result.summary["wrong_input"]]
        assert first == "localisation jumps"
        assert set(others) <= {LASTING}
    assert np.mean(inside) > 0.85


def test_the_whole_map_shares_the_error() -> None:
    """Distances inside the map are surer than places."""
    log = jumping(2, True)
    result = mapped(log, "correct")
    shared = result.map.shared_covariance
    assert shared is not None
    centre = np.mean([item.position for item in result.map.resolved()], axis=0)
    lever = jacobian(centre)
    sigma = np.sqrt(np.linalg.eigvalsh(lever @ shared @ lever.T)[-1])
    assert sigma == pytest.approx(0.125, abs=0.03)


def drifting(seed: int) -> Log:
    """A drive whose localisation drifts by 0.4 m in the 15 s before it corrects itself by a jump, in the middle."""
    noise = {"localization": PoseNoise(xy=0.008, yaw=0.0016), "pixel_sigma": 2.0}
    log = simulate(preset("demo", odometry=None, objects=12, classes=12, frames=300, false=0.0, **noise), seed)
    path = log.localization
    assert path is not None
    middle, poses = np.median(path.stamps), path.poses.copy()
    drift = np.clip((path.stamps - middle + 15) / 15, 0, None) * (path.stamps < middle)
    poses[:, :2, 3] += 0.4 * drift[:, None] * [0.6, 0.8]
    return replace(log, localization=replace(path, poses=poses))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_boxes_tell_a_correction_from_a_mistake(seed: int) -> None:
    settings = load_settings(None, ("mode=fixed",))
    right, wrong = drifting(seed), jumping(seed, True)
    assert find_jumps(right, settings) is not None
    assert wrong_jumps(right, settings) is None
    assert wrong_jumps(wrong, settings) is not None


def lost(seed: int) -> Log:
    """A drive with odometry, whose localisation is lost for a quarter of the time, 1.4 m and 14 degrees off."""
    noise = {"localization": PoseNoise(xy=0.008, yaw=0.0016), "pixel_sigma": 2.0}
    log = simulate(preset("demo", objects=12, classes=12, frames=300, false=0.0, **noise), seed)
    path = log.localization
    assert path is not None
    begin, end = np.quantile(path.stamps, [0.4, 0.65])
    away = (path.stamps > begin) & (path.stamps < end)
    poses = path.poses.copy()
    poses[away] = lift_se2(np.array([[1.2, 0.7, 0.25]]))[0] @ poses[away]
    return replace(log, localization=replace(path, poses=poses))


def test_the_odometry_maps_a_log_whose_localisation_was_lost() -> None:
    log, ledger = lost(0), Ledger()
    result = pipeline.run(log, load_settings(None, ("output.recording=false", "bodies.use=false")), ledger)
    assert result.summary["map_frame"] == "odometry"
    assert result.summary["assessment"]["level"] == "check"
    assert "without the localisation" in result.summary["assessment"]["reasons"][0]
    assert any("localisation jumps" in warning for warning in ledger.warnings)
    assert log.truth is not None
    found = evaluate(result.map, log.truth, align="se2", radius=0.5).objects
    assert len(found.matches) >= 11
    assert np.sqrt((found.errors**2).mean()) < 0.15


def test_a_lost_localisation_that_the_settings_ask_for_is_kept() -> None:
    settings = load_settings(None, ("output.recording=false", "bodies.use=false", "poses.use=localization"))
    result = pipeline.run(lost(0), settings, Ledger())
    assert result.summary["map_frame"] == "localization"
    assert result.summary["assessment"]["level"] != "good"
