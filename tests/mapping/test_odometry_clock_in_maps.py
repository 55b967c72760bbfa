"""Maps of logs whose odometry and localisation have two clocks."""

from __future__ import annotations

import pytest
from turning_drive import of_two_clocks

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.frontend.localization.odometry_clock import at_one_clock
from objslam.mapping import pipeline


def mapped(log: Log, *overrides: str) -> RunResult:
    given = ("mode=joint", "output.recording=false", "bodies.use=false", "checks.use=false", "association.method=by_label")
    return pipeline.run(log, load_settings(None, (*given, *overrides)), Ledger())


def clock_of_camera(result: RunResult) -> float:
    return float(result.summary["calibration"]["parameters"]["front.clock"]["value"])


@pytest.mark.parametrize("offset", [-0.25, 0.25])
def test_a_map_has_the_clock_of_the_localisation(offset: float) -> None:
    result = mapped(of_two_clocks(offset))
    clock = result.summary["odometry_clock"]
    assert abs(clock["offset"] - offset) < 3 * clock["sigma"]
    assert any(line.startswith("the odometry's stamps are 0.25 s") for line in result.summary["warnings"])
    assert abs(clock_of_camera(result)) < 0.02


def test_a_log_of_one_clock_does_not_change() -> None:
    log, ledger = of_two_clocks(0.0), Ledger()
    assert at_one_clock(log, load_settings(None, ()), ledger) == (log, None)
    assert ledger.warnings == []
    assert mapped(log).summary["odometry_clock"] is None
