"""The mode that a run takes if the settings leave it open."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lasting_localization import with_lasting
from quick import HELD

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.disagreement import DISAGREE
from objslam.mapping.stages import described, measurements, solved
from objslam.simulation import PoseNoise, preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")


@cache
def drive() -> Log:
    changes = {
        "objects": 10,
        "classes": 10,
        "frames": 200,
        "odometry": Odometry(),
        "localization": PoseNoise(xy=0.02, yaw=0.005),
    }
    return simulate(preset("demo", **changes), 5)


@cache
def mapped(without: str, *more: str) -> RunResult:
    """The result of the drive without one of its paths, or with both."""
    log = replace(drive(), **{without: None}) if without else drive()
    return pipeline.run(log, load_settings(None, ("output.recording=false", "bodies.use=false", *more)), Ledger())


@pytest.mark.parametrize(
    ("without", "more", "mode"),
    [
        ("", HELD, "fixed"),
        ("odometry", HELD, "fixed"),
        ("localization", (), "joint"),
        ("", ("poses.use=odometry", *HELD), "joint"),
        ("localization", ("mode=fixed",), "fixed"),
        ("", ("mode=joint", *HELD), "joint"),
    ],
)
def test_a_log_without_localisation_is_solved_jointly(without: str, more: tuple[str, ...], mode: str):
    result = mapped(without, *more)
    assert result.settings.mode == result.summary["mode"] == mode


def test_from_plain_odometry_the_truth_lies_in_the_ellipsoids_of_the_default_mode():
    """Fixed objects smear along the drift, and their covariances contain only a part of that."""

    def inside(*more: str) -> float:
        found = evaluate(mapped("localization", *more).map, drive().truth, align="se2", radius=2.0)
        return float(np.nan_to_num(found.to_dict()["inside_95"]))

    assert inside() >= 0.8
    assert inside("mode=fixed") < 0.8


ALONE = ("output.recording=false", "bodies.use=false", "calibration.use=false")


def metres_off() -> Log:
    """A drive at positions that err by 0.8 m for 20 s, as between houses."""
    room = {"objects": 6, "classes": 6, "frames": 150, "odometry": Odometry(), "pixel_sigma": 2.0}
    return with_lasting(simulate(preset("demo", **room, localization=PoseNoise(xy=0.3, yaw=0.005)), 3), 40.0, 20.0, 3)


def without_boxes_that_tell(monkeypatch) -> None:
    for check in ("check_lasting_noise", "check_pose_noise", "check_residuals"):
        monkeypatch.setattr(described, check, lambda *_, **__: None)


@pytest.mark.long
def test_the_odometry_tells_that_a_localisation_errs_by_a_metre(monkeypatch):
    """As satellite positioning between houses does. At its poses, each thing becomes several objects, which explain their
    boxes, so the boxes do not tell."""
    without_boxes_that_tell(monkeypatch)
    log = metres_off()
    result = pipeline.run(log, load_settings(None, ALONE), Ledger())
    assert result.summary["mode"] == "joint"
    assert any("the odometry shows that the localisation errs" in said for said in result.summary["warnings"])
    found = evaluate(result.map, log.truth, align="none", radius=4.0).to_dict()
    assert (found["matched"], found["false"], found["inside_95_3d"]) == (6, 0, 1.0)


def test_odometry_of_another_time_costs_no_map(monkeypatch):
    """It has no pose at any frame, so it cannot say whether the localisation errs."""
    without_boxes_that_tell(monkeypatch)
    log = metres_off()
    log = replace(log, odometry=Trajectory(log.odometry.stamps + 1e4, log.odometry.poses))
    result = pipeline.run(log, load_settings(None, ALONE), Ledger())
    assert result.summary["mode"] == "fixed"
    assert result.summary["assessment"]["level"] != "good"


@pytest.mark.parametrize(
    ("more", "odometry", "basis", "told"),
    [
        ((), True, "boxes", False),
        ((), True, "log", True),
        ((), False, "boxes", True),
        (("mode=fixed",), True, "boxes", True),
    ],
    ids=["a joint solve may refute it", "no solve can refute it", "without odometry", "the poses stay as given"],
)
def test_wrong_input_is_named_before_the_solve_unless_a_second_solve_may_refute_it(
    monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...], odometry: bool, basis: str, told: bool
):
    message, ledger = "the boxes disagree with the poses", Ledger()
    monkeypatch.setattr(
        measurements, "diagnose", lambda *given: Diagnosis((Finding(DISAGREE, message, spoils=False, basis=basis),))
    )

    class Solved(Exception):
        """The solve began."""

    def solve(*given, **named):
        raise Solved(message in ledger.warnings)

    monkeypatch.setattr(solved, "solve", solve)
    log = drive() if odometry else replace(drive(), odometry=None)
    with pytest.raises(Solved) as begun:
        pipeline.run(log, load_settings(None, (*HELD, "checks.use=true", *more)), ledger)
    assert begun.value.args == (told,)
