"""The one rule of which objects have a position to rely on."""

import numpy as np
import pytest
import torch

from objslam.config import Triangulation
from objslam.core.status import is_resolved, reach, status_of

LIMITS = Triangulation(min_parallax_deg=3.0, max_rel_sigma=0.5)
GOOD = {"sigma": 0.1, "reach": 2.0, "rays": 5, "parallax": np.radians(10.0), "ranged": False}


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({}, "ok"),
        ({"sigma": 1.0}, "ok"),
        ({"sigma": 1.01}, "unresolved"),
        ({"sigma": np.inf}, "unresolved"),
        ({"sigma": np.nan}, "unresolved"),
        ({"reach": np.nan}, "unresolved"),
        ({"rays": 2}, "ok"),
        ({"rays": 1}, "unresolved"),
        ({"rays": 1, "ranged": True}, "unresolved"),
        ({"parallax": np.radians(2.9)}, "unresolved"),
        ({"parallax": np.radians(2.9), "ranged": True}, "ok"),
    ],
)
def test_what_an_object_needs(change, status):
    assert status_of(**{**GOOD, **change}, limits=LIMITS) == status


def test_arrays_and_tensors_say_the_same():
    rng = np.random.default_rng(0)
    columns = rng.uniform(0, 2, 200), rng.uniform(0, 4, 200), rng.integers(0, 4, 200), rng.uniform(0, 0.1, 200)
    ranged = rng.random(200) < 0.3
    columns[0][:20] = np.nan
    found = is_resolved(*columns, ranged, LIMITS)
    assert 20 < found.sum() < 180
    of_tensors = is_resolved(*(torch.from_numpy(c) for c in columns), torch.from_numpy(ranged), LIMITS)
    np.testing.assert_array_equal(of_tensors.numpy(), found)
    rows = zip(*(c.tolist() for c in columns), ranged.tolist(), strict=True)
    assert [status_of(*row, LIMITS) == "ok" for row in rows] == found.tolist()


def test_reach_is_the_median_distance():
    assert reach(np.zeros(3), np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 9]])) == 2.0
    assert np.isnan(reach(np.zeros(3), np.zeros((0, 3))))
