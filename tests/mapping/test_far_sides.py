"""The far side of objects with little parallax, against drawn parallaxes and simulated drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from quick import HELD

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.mapping.fixed.far_sides import far_sigma, with_far_sides
from objslam.mapping.stages import described
from objslam.simulation import preset, simulate


@pytest.mark.parametrize("share", [0.02, 0.1, 0.2])
def test_the_far_end_of_a_depth_from_two_views_is_reached_as_often_as_promised(share):
    """Two views, 1 m apart, see a thing at 5 m under a parallax with noise. share: the sigma of the depth, by the depth."""
    rng = np.random.default_rng(0)
    parallax = 1 / 5 * (1 + share * rng.standard_normal(200_000))
    depth = 1 / parallax
    sigma = share / 5 * depth**2
    inside = np.mean(5 - depth < 2 * far_sigma(sigma, depth))
    assert inside == pytest.approx(0.977, abs=0.002)  # Of a normal distribution, as much is below two standard deviations.
    if share >= 0.1:
        assert np.mean(5 - depth < 2 * sigma) < 0.965


def test_only_objects_without_ranges_that_were_seen_from_one_side_become_wider(monkeypatch):
    made = []
    monkeypatch.setattr(described, "with_far_sides", lambda solution: made.append(solution) or with_far_sides(solution))
    log = simulate(preset("demo", odometry=None, objects=6, classes=6, frames=150, false=0.0), 0)
    settings = load_settings(None, ("mode=fixed", *HELD, "output.recording=false"))
    pipeline.run(log, settings, Ledger())
    (solution,) = made
    sigma = np.sqrt(np.linalg.eigvalsh(solution.estimate.covariance)[:, -1])
    after = np.sqrt(np.linalg.eigvalsh(with_far_sides(solution).estimate.covariance)[:, -1])
    assert (sigma < 0.15).all()
    assert (after < 1.15 * sigma).all()  # They were seen from many sides.
    large = replace(
        solution, estimate=replace(solution.estimate, covariance=solution.estimate.covariance * (1 / sigma.min()) ** 2)
    )
    more = with_far_sides(large).estimate.covariance - large.estimate.covariance
    assert (np.linalg.eigvalsh(more)[:, -1] > 0.1).all()
    assert (np.linalg.eigvalsh(more)[:, :2] < 1e-6).all()  # They become wider along one axis only.
    ranges = np.full(len(solution.rays), 2.0)
    ranged = replace(large, rays=replace(large.rays, range=ranges, range_sigma=0.1 * ranges))
    np.testing.assert_array_equal(with_far_sides(ranged).estimate.covariance, large.estimate.covariance)
