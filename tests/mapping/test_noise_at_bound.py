"""With enough noise, wrong input fits too, so a run says that a noise ended at its bound."""

from types import SimpleNamespace

import numpy as np
import pytest

from objslam.core.noise import MOST_NOISE, NoiseFactors
from objslam.mapping.checks.shared_errors import at_bounds


@pytest.mark.parametrize(("name", "spoils"), [("rays", True), ("across", False), ("turning", False)])
def test_a_noise_at_its_bound_is_said(name, spoils):
    estimate = SimpleNamespace(calibration=None, noise=NoiseFactors(**{name: MOST_NOISE}))
    (found,) = at_bounds(estimate, np.zeros(0))
    assert found.name == f"noise {name} at its bound"
    assert found.spoils == spoils


@pytest.mark.parametrize("depth", ["ranges", "range_bias"])
def test_depths_and_odometry_are_not_both_so_bad(depth):
    """A recorded drive with the identity for base_T_camera had both, and objects that were off by 4 m."""
    alone, both = (NoiseFactors(**dict.fromkeys(names, MOST_NOISE)) for names in ((depth,), (depth, "along")))
    told = [at_bounds(SimpleNamespace(calibration=None, noise=noise), np.zeros(0)) for noise in (alone, both)]
    assert [finding.spoils for finding in told[0]] == [False]
    assert [finding.spoils for finding in told[1]] == [True, True]


def test_the_noise_of_bad_wheels_is_not_said():
    """The odometry of a MRCLAM robot is only the commanded speed."""
    assert at_bounds(SimpleNamespace(calibration=None, noise=NoiseFactors(along=6.3)), np.zeros(0)) == []
