"""A localisation that begins late or pauses: the odometry continues it, and boxes of all times count."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.mapping import pipeline
from objslam.mapping.checks.stamps import check_stamps
from objslam.mapping.stages import solved
from objslam.simulation import preset, simulate

QUIET = ("bodies.use=false", "output.recording=false")


def partial(keep) -> Log:
    """The demo's drive with odometry. keep: which shares of its time have a localisation."""
    log = simulate(preset("demo", frames=150), 5)
    path = log.localization
    kept = keep((path.stamps - path.stamps[0]) / np.ptp(path.stamps))
    return replace(log, localization=Trajectory(path.stamps[kept], path.poses[kept]))


def right(result, log: Log) -> int:
    """The number of true things with an object of their label within its 99.9 % ellipsoid, and within 0.3 m."""
    number = 0
    for true in log.truth.objects:
        for item in result.map.resolved():
            off = item.position - true.position
            near = item.label == true.label and np.linalg.norm(off) < 0.3
            number += bool(near and off @ np.linalg.solve(item.covariance, off) < 16.3)
    return number


@pytest.mark.parametrize("keep", [lambda t: t > 0.4, lambda t: (t < 0.3) | (t > 0.45)])
def test_all_boxes_count(keep):
    log = partial(keep)
    ledger = Ledger()
    whole = pipeline.run(log, load_settings(None, QUIET), ledger)
    fixed = pipeline.run(log, load_settings(None, (*QUIET, "mode=fixed")), Ledger())
    assert whole.summary["mode"] == "joint"
    assert whole.summary["map_frame"] == "localization"
    assert any("the odometry continues the localisation" in line for line in ledger.lines())
    assert not any("localisation" in line and "boxes before" in line for line in ledger.lines())
    assert len(whole.keyframes) > 1.1 * len(fixed.keyframes)
    assert right(whole, log) == len(whole.map.resolved()) == len(log.truth.objects)
    assert right(fixed, log) <= right(whole, log)


def test_a_late_localisation_has_no_other_clock():
    log = partial(lambda t: t > 0.7)
    assert check_stamps(log) is None
    other = replace(log, odometry=None)
    assert check_stamps(other).name == "stamps apart"


def test_a_log_whose_poses_cannot_be_solved_is_mapped_at_the_localised_ones(monkeypatch):
    solve = solved.solve

    def failing(frames, rays, cameras, settings, *more, **named):
        if settings.mode == "joint":
            raise SolveError("singular")
        return solve(frames, rays, cameras, settings, *more, **named)

    monkeypatch.setattr(solved, "solve", failing)
    ledger = Ledger()
    result = pipeline.run(partial(lambda t: t > 0.4), load_settings(None, QUIET), ledger)
    assert result.summary["mode"] == "fixed"
    assert result.map.resolved()
    assert any("the poses cannot be solved: singular" in line for line in ledger.lines())
