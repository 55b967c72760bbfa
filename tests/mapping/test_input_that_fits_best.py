"""Boxes that fit poorly at right poses, because the poses are noisy: the input is right if the log fits best as it is."""

from dataclasses import replace

import pytest
from lasting_localization import with_lasting
from wrong_inputs import MISTAKES

from objslam.config import load_settings
from objslam.core.types import Log
from objslam.mapping.checks.agreement import agreement, bounded_part
from objslam.mapping.checks.hypotheses import disagreement
from objslam.mapping.checks.hypotheses.every import later, with_headings
from objslam.mapping.checks.hypotheses.trials import try_hypotheses
from objslam.simulation import PoseNoise, preset, simulate

SETTINGS = load_settings(None, ("mode=fixed",))


def street() -> Log:
    """Two laps past 30 things of four labels. The places err by 0.4 m and the headings by 0.8 degrees, for 20 s each."""
    drive = {"room": (50.0, 35.0), "objects": 30, "classes": 4, "frames": 250, "laps": 2.0, "max_range": 25.0}
    noise = {"pixel_sigma": 2.0, "missed": 0.2, "false": 0.1, "localization": PoseNoise(xy=0.02, yaw=0.003)}
    log = simulate(preset("demo", odometry=None, **drive, **noise), 0)
    return with_lasting(log, 20.0, 20.0, 0, yaw=0.0007)


def backwards(log: Log) -> Log:
    """The log with its poses in the opposite order: the poses of another drive through the same place."""
    path = log.localization
    return replace(log, localization=replace(path, poses=path.poses[::-1].copy()))


WRONG = {
    "turned by 12 degrees": lambda log: with_headings(log, 12.0),
    "turned by 25 degrees": lambda log: with_headings(log, -25.0),
    "clock": lambda log: later(log, 0.5),
    "another drive": backwards,
    "y negated": MISTAKES["y of poses negated"],
    "inverted": MISTAKES["base_T_camera inverted"],
}


@pytest.mark.parametrize(("name", "accused"), [("none", False), *((name, True) for name in WRONG)])
def test_boxes_at_noisy_poses_are_accused_only_if_the_log_does_not_fit_best(name, accused, monkeypatch):
    """Any score would be accused here, so only the comparison with other turns and clocks decides."""
    monkeypatch.setattr(disagreement, "_BAD_SCORE", 1.0)
    monkeypatch.setattr(disagreement, "_TIMES", 100.0)
    log = street() if name == "none" else WRONG[name](street())
    part = bounded_part(log, SETTINGS)
    found = agreement(part, part.log, SETTINGS)
    trials = try_hypotheses(part, log, found, SETTINGS, lambda stage, done, total: None)
    assert (disagreement.disagree(found, trials, part, SETTINGS) is not None) == accused
