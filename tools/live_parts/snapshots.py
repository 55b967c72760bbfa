"""Sessions whose localisation errs for seconds: the last snapshot, with the noise of the settings and with the noise that a
session finds."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from lasting_localization import with_lasting

from live_parts.common import replayed, settings_for
from objslam.config import Odometry
from objslam.evaluation.evaluate import evaluate
from objslam.simulation import PoseNoise, preset, simulate

DRIVES, FRAMES = 10, 400  # of each kind
_LIMIT = 7.815  # The 95 % quantile of chi-squared with 3 degrees of freedom.
ERRORS = ((2.5, 2.0), (4.0, 3.0))
"""The factors on `localization.xy` and `localization.yaw`, and how long the errors last, s. One after the other in turn."""


def localised() -> None:
    """Compare the last snapshots of sessions with the truth."""
    print(f"a localisation that errs for seconds: the last snapshots of {DRIVES} sessions a row, not aligned")
    print(f"{'log':<24}{'noise':<14}{'found':>7}{'false':>7}{'RMSE m':>9}{'inside 95 %':>13}")
    for what, odometry in (("with odometry", Odometry()), ("localisation alone", None)):
        logs = []
        for seed in range(DRIVES):
            room = {"frames": FRAMES, "classes": 6, "pixel_sigma": 2.0, "odometry": odometry}
            log = simulate(preset("demo", **room, localization=PoseNoise(xy=0.002, yaw=0.0005)), seed)
            logs.append(with_lasting(log, *ERRORS[seed % len(ERRORS)], seed))
        for noise, change in (("settings", "noise.localization=false"), ("found", "noise.localization=auto")):
            found, false, squared, errors = 0, 0, [], []
            for log in logs:
                session = replayed(log, settings_for("rays.pixel_sigma=2", change))
                score = evaluate(session.snapshot().map, log.truth, align="none", radius=1.0).objects
                session.abort()
                found, false = found + len(score.matches), false + len(score.false)
                squared += [one.squared_3d for one in score.matches if one.squared_3d is not None]
                errors += score.errors.tolist()
            inside, rmse = np.mean(np.array(squared) < _LIMIT), np.sqrt(np.mean(np.square(errors)))
            print(f"{what:<24}{noise:<14}{found:>7}{false:>7}{rmse:>9.3f}{inside:>13.1%}", flush=True)
