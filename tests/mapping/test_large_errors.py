"""Large shared errors are named, measured from what was expected before the log."""

import numpy as np

from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.mapping.checks.shared_errors import warn_of_large_errors


def warnings(value, mean, sigma):
    ledger = Ledger()
    found = Calibration(("front.clock",), np.array([value]), np.array([[1e-6]]), np.array([sigma]), np.array([mean]))
    warn_of_large_errors(found, ledger)
    return ledger.warnings


def test_an_error_as_in_the_calibration_file_is_no_surprise():
    assert warnings(0.201, 0.2, 0.002) == []


def test_an_error_far_from_the_calibration_file_is_named():
    (said,) = warnings(0.15, 0.2, 0.002)
    assert "front.clock is 0.15 s, 25.0 times its prior sigma from the 0.2 s of the calibration file" in said


def test_an_error_far_from_the_settings_is_named():
    (said,) = warnings(0.4, 0.0, 0.1)
    assert "front.clock is 0.4 s, 4.0 times its prior sigma: do the stamps" in said
    assert warnings(0.2, 0.0, 0.1) == []
