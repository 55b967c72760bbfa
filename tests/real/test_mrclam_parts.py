"""Parts of MRCLAM logs: short ones, whose camera's clock is 0.2 s off, and halves, which must tell the same errors."""

import numpy as np
import pytest
from log_parts import part

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read


def mapped(log: Log) -> RunResult:
    return pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false", "checks.use=false")), Ledger())


@pytest.mark.parametrize(("robot", "end", "fewest", "farthest"), [(3, 60, 8, 0.1), (1, 150, 3, 0.15)])
def test_a_short_part_from_bearings_has_one_object_for_each_label(data_dir, robot, end, fewest, farthest):
    log = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=robot, with_range=False))
    result = mapped(part(log, 0, end))
    found = evaluate(result.map, log.truth, align="se2", radius=2.0).to_dict()
    assert result.summary["rounds"] == []
    assert found["matched"] >= fewest
    assert found["false"] == 0
    assert found["position_rmse"] < farthest
    assert found["inside_95"] >= 0.9


def test_both_halves_of_a_log_tell_the_same_errors(data_dir):
    log = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=3, with_range=False))
    middle = (log.odometry.stamps[-1] - log.odometry.stamps[0]) / 2
    first, second = (mapped(part(log, *times)).calibration for times in ((0, middle), (middle, 2 * middle)))
    assert first.names == second.names
    apart = np.abs(first.values - second.values) / np.hypot(first.sigma, second.sigma)
    assert (apart < 3).all(), dict(zip(first.names, apart, strict=True))
    k = first.names.index("camera.clock")
    assert max(first.sigma[k], second.sigma[k]) < 0.02
