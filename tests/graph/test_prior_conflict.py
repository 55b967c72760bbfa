"""Priors that are too narrow for a robot do not make a covariance too small."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t as student

from objslam.core.calibration import Calibration
from objslam.graph.calibration.prior_conflict import with_wider_priors

SIGMA = np.array([0.03, 0.02])
SUM = 1e-4
"""The standard deviation of the measured sum of the two errors."""


def of_sum(measured: float) -> Calibration:
    """Two errors with the priors SIGMA, of which a log tells only the sum."""
    information = np.ones((2, 2)) / SUM**2 + np.diag(SIGMA**-2)
    covariance = np.linalg.inv(information)
    return Calibration(("a", "b"), covariance @ np.full(2, measured / SUM**2), covariance, SIGMA)


def widened(measured: float) -> Calibration:
    return with_wider_priors(of_sum(measured), np.zeros(2), np.diag(SIGMA**2))


@given(st.floats(-2.0, 2.0))
def test_a_sum_within_two_sigmas_of_its_prior_changes_nothing(pull):
    found = widened(pull * float(np.hypot(*SIGMA)))
    assert found.prior_factor is None


@pytest.mark.parametrize("measured", [0.1, 0.13, 0.16])
def test_the_sigma_of_a_conflict_is_near_that_of_a_student_prior(measured):
    found = widened(measured)
    grid = np.linspace(-0.3, 0.3, 20001)
    weight = student.pdf(grid / SIGMA[0], 4) * student.pdf((measured - grid) / SIGMA[1], 4)
    weight /= weight.sum()
    spread = np.sqrt(weight @ (grid - weight @ grid) ** 2)
    assert found.sigma[0] == pytest.approx(spread, rel=0.4)
    assert found.sigma[0] > 1.5 * of_sum(measured).sigma[0]
    assert np.ones(2) @ found.covariance @ np.ones(2) == pytest.approx(SUM**2, rel=0.01)


def test_an_error_that_the_log_tells_alone_keeps_its_sigma():
    covariance = np.diag([1e-6, SIGMA[1] ** 2 / 2])
    found = with_wider_priors(
        Calibration(("a", "b"), np.array([0.2, 0.0]), covariance, SIGMA), np.zeros(2), np.diag(SIGMA**2)
    )
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diagonal(covariance)), rtol=1e-3)
    assert found.prior_factor[0] > 5
    assert found.prior_factor[1] == 1


def test_no_errors_need_no_priors():
    nothing = Calibration((), np.zeros(0), np.zeros((0, 0)), np.zeros(0))
    assert with_wider_priors(nothing, np.zeros(0), np.zeros((0, 0))) is nothing
