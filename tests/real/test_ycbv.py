"""DOPE on YCB-Video, camera poses known: whether the covariance of a place holds the truth."""

import numpy as np
import pytest
from ycbv import RUNS, read_ycbv

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_the_truth_is_inside_the_ellipsoid(data_dir, mode):
    squares, errors, sigmas = [], [], []
    for name, run in RUNS:
        log = read_ycbv(data_dir / "ycbv_dope", name, run)
        result = pipeline.run(
            log, load_settings(None, (f"mode={mode}", "output.recording=false", "checks.use=false")), Ledger()
        )
        (best,) = result.map.resolved()  # Wrong poses of the object, some larger than the image, are no second object.
        off = best.position - log.truth.objects[0].position
        squares.append(off @ np.linalg.solve(best.covariance, off))
        errors.append(np.linalg.norm(off))
        sigmas.append(np.sqrt(np.trace(best.covariance)))
    assert (np.array(squares) < 7.815).sum() >= 4
    assert 0.5 < np.median(sigmas) / np.median(errors) < 2.0
