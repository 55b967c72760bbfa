"""The last snapshots of sessions against the truth: with a localisation that errs for seconds, with things that are seldom
seen, and with things of one label."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from lasting_localization import with_lasting

from live_parts.common import replayed, settings_for
from objslam.config import Odometry
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.simulation import PoseNoise, preset, simulate

DRIVES, FRAMES = 10, 400  # of each kind
_LIMIT = 7.815  # The 95 % quantile of chi-squared with 3 degrees of freedom.
ERRORS = ((2.5, 2.0), (4.0, 3.0))
"""The factors on `localization.xy` and `localization.yaw`, and how long the errors last, s. One after the other in turn."""
_RARE = 0.8
"""The share of boxes that the detector of `rare` misses."""


def localised() -> None:
    """With the noise of the settings, and with the noise that a session finds."""
    _head(f"a localisation that errs for seconds: the last snapshots of {DRIVES} sessions a row, not aligned", "noise")
    for what, odometry in (("with odometry", Odometry()), ("localisation alone", None)):
        logs = []
        for seed in range(DRIVES):
            room = {"frames": FRAMES, "classes": 6, "pixel_sigma": 2.0, "odometry": odometry}
            log = simulate(preset("demo", **room, localization=PoseNoise(xy=0.002, yaw=0.0005)), seed)
            logs.append(with_lasting(log, *ERRORS[seed % len(ERRORS)], seed))
        _row(what, "settings", logs, "none", "noise.localization=false")
        _row(what, "found", logs, "none", "noise.localization=auto")


def rare() -> None:
    """Without and with a search among earlier boxes."""
    _head(f"{_RARE:.0%} of the boxes missed: the last snapshots of {DRIVES} sessions a row, aligned by SE(2)", "search")
    room = {"frames": FRAMES, "classes": 6, "pixel_sigma": 2.0, "missed": _RARE, "false": 0.0, "localization": None}
    logs = [simulate(preset("demo", **room), seed) for seed in range(DRIVES)]
    _row("odometry", "none", logs, "se2", "live.search_from=0")
    _row("odometry", "default", logs, "se2", "live.search_from=75")


def unnamed() -> None:
    """Without and with an association of the whole drive again."""
    _head(f"one label for all things: the last snapshots of {DRIVES} sessions a row, aligned by SE(2)", "associated")
    room = {"frames": FRAMES, "classes": 1, "objects": 12, "pixel_sigma": 2.0, "false": 0.0, "localization": None, "laps": 3}
    logs = [simulate(preset("demo", **room), seed) for seed in range(DRIVES)]
    _row("odometry", "once", logs, "se2", "live.search_from=0")
    _row("odometry", "again (default)", logs, "se2", "live.search_from=75")


def _head(title: str, change: str) -> None:
    print(title)
    print(f"{'log':<24}{change:<17}{'found':>7}{'false':>7}{'RMSE m':>9}{'inside 95 %':>13}")


def _row(what: str, name: str, logs: list[Log], align: str, change: str) -> None:
    """Compare the last snapshots of these logs with the truth."""
    found, false, squared, errors = 0, 0, [], []
    for log in logs:
        session = replayed(log, settings_for("rays.pixel_sigma=2", change))
        score = evaluate(session.snapshot().map, log.truth, align=align, radius=1.0).objects
        session.abort()
        found, false = found + len(score.matches), false + len(score.false)
        squared += [one.squared_3d for one in score.matches if one.squared_3d is not None]
        errors += score.errors.tolist()
    inside, rmse = np.mean(np.array(squared) < _LIMIT), np.sqrt(np.mean(np.square(errors)))
    print(f"{what:<24}{name:<17}{found:>7}{false:>7}{rmse:>9.3f}{inside:>13.1%}", flush=True)
