"""Joint mode with a localisation and no odometry: the errors of cameras are found, and the covariances have the rest."""

import numpy as np
import pytest
from added_errors import add_shared_errors
from scipy.stats import chi2

from objslam.config import load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.graph.calibration import self_calibration
from objslam.mapping import pipeline
from objslam.mapping.checks.assessment import Evidence, assess, evidence_of
from objslam.simulation import preset, simulate

TURNS, PLACE, LENS = (
    {"roll": 0.02, "tilt": 0.02, "yaw": 0.03},
    dict.fromkeys("xyz", 0.05),
    dict.fromkeys(("focal", "cx", "cy"), 0.02),
)
QUIET = ("mode=joint", "output.recording=false", "checks.use=false", "bodies.use=false", "noise.localization=false")
"""The localisation has the noise of the settings."""
PRIORS = {"clock": 0.1, **TURNS, **PLACE, **LENS}


def drive(seed: int, errors: dict[str, float]) -> Log:
    """A localised drive past 12 objects of 12 labels, with these errors of its camera."""
    log = simulate(preset("demo", frames=200, pixel_sigma=3.0, objects=12, classes=12, odometry=None), seed)
    return add_shared_errors(log, {f"front.{name}": value for name, value in errors.items()})


def mapped(log: Log, *changes: str) -> tuple[RunResult, Floats, Floats]:
    """The result in joint mode, and the errors (n, 3) m and covariances (n, 3, 3) of its objects."""
    result = pipeline.run(log, load_settings(None, (*QUIET, *changes)), Ledger())
    assert log.truth is not None
    true = {one.label: one.position for one in log.truth.objects}
    found = result.map.resolved()
    assert sorted(one.label for one in found) == sorted(true)
    return result, np.array([one.position - true[one.label] for one in found]), np.array([one.covariance for one in found])


@pytest.mark.long
def test_errors_drawn_from_their_priors_are_found_and_the_map_is_honest() -> None:
    squared = []
    for seed in range(4):
        rng = np.random.default_rng((seed, 7))
        errors = {name: sigma * rng.standard_normal() for name, sigma in PRIORS.items()}
        result, off, covariance = mapped(drive(seed, errors))
        found = result.calibration
        assert found is not None
        assert set(found.names) == {f"front.{name}" for name in PRIORS}
        true = np.array([errors[name.partition(".")[2]] for name in found.names])
        assert (np.abs(found.values - true) < 3 * found.sigma).all()
        # The log tells the clock and the focal length, and of a rotation and the image centre what they have in common. It
        # does not tell the height of the camera, which moves all objects.
        sigma = dict(zip(found.names, found.sigma.tolist(), strict=True))
        assert all(sigma[f"front.{name}"] < PRIORS[name] / 2 for name in ("clock", "roll", "focal"))
        for pair in (("front.tilt", "front.cy"), ("front.yaw", "front.cx")):
            at = [found.names.index(name) for name in pair]
            assert np.linalg.eigvalsh(found.covariance[np.ix_(at, at)])[0] < (LENS["cx"] / 4) ** 2
        assert np.sqrt(covariance[:, 2, 2]).min() > 0.9 * PRIORS["z"]
        squared.append(np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0]))
    assert np.mean(np.concatenate(squared) < chi2.ppf(0.95, 3)) >= 0.95


def test_a_coarse_localisation_leaves_what_it_does_not_tell_to_the_prior() -> None:
    coarse, _, _ = mapped(drive(1, {"clock": 0.1, "tilt": 0.02}), "localization.xy=0.4")
    fine, _, _ = mapped(drive(1, {"clock": 0.1, "tilt": 0.02}))
    assert coarse.calibration is not None
    assert fine.calibration is not None
    clock = fine.calibration.names.index("front.clock")
    assert coarse.calibration.sigma[clock] > 3 * fine.calibration.sigma[clock]


def test_a_lens_that_may_err_is_found_too() -> None:
    result, _, _ = mapped(drive(3, {"focal": 0.03, "yaw": 0.02}), "calibration.focal=0.02")
    found = result.calibration
    assert found is not None
    focal = found.names.index("front.focal")
    assert found.sigma[focal] < 0.01
    assert abs(found.values[focal] - 0.03) < 3 * found.sigma[focal]


def test_a_calibration_that_fails_makes_the_verdict_check(monkeypatch) -> None:
    log, settings = drive(0, {}), load_settings(None, QUIET)
    assert not assessed(pipeline.run(log, settings, Ledger())).uncalibrated

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr(self_calibration, "calibrate", fails)
    evidence = assessed(pipeline.run(log, settings, Ledger()))
    assert evidence.uncalibrated
    assert assess(evidence).level == "check"


def assessed(result: RunResult) -> Evidence:
    """The evidence of a result whose rays miss as far as expected."""
    return evidence_of(result.summary, 1.0)
