"""Maps of logs whose odometry and localisation have two clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_drive import drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.result import RunResult
from objslam.core.types import Log, Trajectory
from objslam.frontend.localization.odometry_clock import at_one_clock
from objslam.mapping import pipeline


def localised(offset: float) -> Log:
    """A drive with a noisy localisation, and an odometry whose stamps lack `offset`, s."""
    log, rng = drive(), np.random.default_rng(0)
    path = log.odometry
    assert path is not None
    noisy = path.poses[::2] @ lift_se2(rng.normal(size=(len(path.poses[::2]), 3)) * [0.01, 0.01, 0.005])
    localization = Trajectory(path.stamps[::2], noisy)
    return replace(without_late_images(log), odometry=replace(path, stamps=path.stamps - offset), localization=localization)


def without_late_images(log: Log) -> Log:
    """The log with the first 100 images, so that it is mapped fast."""
    (first,) = log.cameras
    boxes = first.detections
    assert boxes is not None
    early = boxes.frame < 100
    columns = ("frame", "boxes", "label", "scores", "depths", "track_ids")
    kept = {name: getattr(boxes, name)[early] for name in columns}
    return replace(log, cameras=(replace(first, detections=replace(boxes, frame_stamps=boxes.frame_stamps[:100], **kept)),))


def mapped(log: Log, *overrides: str) -> RunResult:
    given = ("mode=joint", "output.recording=false", "bodies.use=false", "checks.use=false", "association.method=by_label")
    return pipeline.run(log, load_settings(None, (*given, *overrides)), Ledger())


def clock_of_camera(result: RunResult) -> float:
    return float(result.summary["calibration"]["parameters"]["front.clock"]["value"])


@pytest.mark.parametrize("offset", [-0.25, 0.25])
def test_a_map_has_the_clock_of_the_localisation(offset: float) -> None:
    result = mapped(localised(offset))
    clock = result.summary["odometry_clock"]
    assert abs(clock["offset"] - offset) < 3 * clock["sigma"]
    assert any(line.startswith("the odometry's stamps are 0.25 s") for line in result.summary["warnings"])
    assert abs(clock_of_camera(result)) < 0.02


def test_a_log_of_one_clock_does_not_change() -> None:
    log, ledger = localised(0.0), Ledger()
    assert at_one_clock(log, load_settings(None, ()), ledger) == (log, None)
    assert ledger.warnings == []
    assert mapped(log).summary["odometry_clock"] is None
