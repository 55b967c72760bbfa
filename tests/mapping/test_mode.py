"""The mode that a run takes if the settings leave it open."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import PoseNoise, preset, simulate


@pytest.fixture(scope="module")
def log() -> Log:
    drive = {
        "objects": 10,
        "classes": 10,
        "frames": 200,
        "odometry": Odometry(),
        "localization": PoseNoise(xy=0.02, yaw=0.005),
    }
    return simulate(preset("demo", **drive), 5)


@pytest.mark.parametrize(
    ("taken", "more", "mode"),
    [
        ({}, (), "fixed"),
        ({"odometry": None}, (), "fixed"),
        ({"localization": None}, (), "joint"),
        ({}, ("poses.use=odometry",), "joint"),
        ({"localization": None}, ("mode=fixed",), "fixed"),
        ({}, ("mode=joint",), "joint"),
    ],
)
def test_a_log_without_localisation_is_solved_jointly(log: Log, taken: dict[str, None], more: tuple[str, ...], mode: str):
    result = pipeline.run(replace(log, **taken), load_settings(None, ("output.recording=false", *more)), Ledger())
    assert result.settings.mode == result.summary["mode"] == mode


def test_from_plain_odometry_the_truth_lies_in_the_ellipsoids_of_the_default_mode(log: Log):
    """Fixed objects smear along the drift, and their covariances do not say so."""
    alone = replace(log, localization=None)

    def inside(*more: str) -> float:
        result = pipeline.run(alone, load_settings(None, ("output.recording=false", *more)), Ledger())
        found = evaluate(result.map, log.truth, align="se2", radius=2.0)
        return float(np.nan_to_num(found.to_dict()["inside_95"]))

    assert inside() >= 0.8
    assert inside("mode=fixed") < 0.5
