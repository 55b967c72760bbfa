"""Large shared errors are named, measured from what was expected before the log."""

import numpy as np

from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.noise import LabelNoise, NoiseFactors
from objslam.mapping.checks.shared_errors import warn_of_large_errors, warn_of_noisy_labels


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


def said_of_labels(*labels, **factors):
    ledger = Ledger()
    warn_of_noisy_labels(NoiseFactors(by_label=labels, **factors), ledger)
    return ledger.warnings


def test_a_label_whose_depths_are_far_noisier_than_the_others_is_named():
    (said,) = said_of_labels(LabelNoise("table", 5.0, 1.0), LabelNoise("plant", 0.9, 0.6), ranges=1.2, range_bias=0.7)
    assert "the label 'table' are 5.0 times as noisy as the settings say, and those of all labels 1.2 times" in said
    (said,) = said_of_labels(LabelNoise("table", 1.5, 3.6), ranges=1.4, range_bias=0.97)
    assert "'table' are 3.6 times" in said


def test_labels_whose_depths_are_as_noisy_as_all_or_as_the_settings_say_are_not_named():
    assert said_of_labels(LabelNoise("table", 5.0, 3.0), ranges=4.5, range_bias=2.8) == []
    assert said_of_labels(LabelNoise("table", 2.0, 1.0), ranges=0.5, range_bias=0.3) == []
