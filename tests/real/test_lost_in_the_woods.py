"""Lost in the woods: the first five minutes of a real robot whose three cameras share their stamps."""

import numpy as np
import pytest
from lost_in_the_woods import read_lost_in_the_woods

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline

SWEEP = 160 / 240 / 15  # s, from the right camera to the left: the laser turns through 240 degrees 15 times a second
BARS = {False: 0.06, True: 0.02}  # m, from bearings alone and with ranges, with half of the observations


@pytest.mark.parametrize("with_range", [False, True])
def test_posts_path_and_clocks(data_dir, with_range):
    """Every second observation. The laser's ranges have no scale error; whether they have one is not asked here."""
    log = read_lost_in_the_woods(data_dir / "lost_in_the_woods", seconds=300.0, every=2, with_range=with_range)
    ledger = Ledger()
    settings = load_settings(None, ("mode=joint", "output.recording=false", "calibration.range_scale=0"))
    result = pipeline.run(log, settings, ledger)
    assert ledger.warnings == []
    assert result.summary["rounds"] == []  # names tell the posts apart
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    found = evaluate(result.map, log.truth, path, align="se2", radius=2.0).to_dict()
    assert (found["matched"], found["missed"], found["false"], found["unresolved"]) == (17, 0, 0, 0)
    assert found["position_rmse"] <= BARS[with_range]
    assert found["ate"] <= 0.05
    assert found["inside_95"] >= 0.9
    # What nobody told the solve: the laser saw the posts to the right first.
    parameters = result.summary["calibration"]["parameters"]
    apart = parameters["left.clock"]["value"] - parameters["right.clock"]["value"]
    sigma = np.hypot(parameters["left.clock"]["sigma"], parameters["right.clock"]["sigma"])
    assert abs(apart - SWEEP) < 4 * sigma < 0.06
    assert apart > 0.02
