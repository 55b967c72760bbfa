"""The noise of residuals with shared errors of places, against dense Gauss functions and simulated noise."""

import numpy as np
import pytest
from peers.street import simulate_street

from objslam.association.few_rays.additional_objects import FewRayEvidence
from objslam.mapping.fixed.few_box_search import Searched, SparseNoise, search_objects
from objslam.mapping.fixed.residual_noise import _System, gain_of_shared_places, noise_of_residuals

PLACE, RANGE, SIGMA = 0.02, 0.1, 0.01
TRUE = SparseNoise(place=60.0, ranges=7.0, rays=4.0)


@pytest.mark.parametrize("shared", [True, False])
def test_the_likelihood_is_that_of_a_dense_gauss_function(shared):
    """Two noises are compared, because the restricted likelihood leaves out constants."""
    rng = np.random.default_rng(4)
    rays, objects, places, far = 24, 5, 7, 30.0
    angle = rng.uniform(0, 2 * np.pi, rays)
    axes = np.stack([np.column_stack([-np.sin(angle), np.cos(angle)]), np.column_stack([np.cos(angle), np.sin(angle)])])
    miss, owner = rng.normal(size=(2, rays)), rng.integers(objects, size=rays)
    owner[:objects] = np.arange(objects)
    place = rng.integers(places, size=rays) if shared else np.arange(rays)
    system = _System(axes, miss, owner, place, 0.5, far)
    by_object = (axes[:, :, None] * (owner[:, None] == np.arange(objects))[None, :, :, None]).reshape(2 * rays, -1)
    by_place = (axes[:, :, None] * (place[:, None] == np.unique(place))[None, :, :, None]).reshape(2 * rays, -1)

    def both(own, factor2):
        weight = np.full((2, rays), 1 / own) * np.linspace(1, 2, rays)
        covariance = np.diag(1 / weight.ravel()) + far * by_object @ by_object.T + 0.5 * factor2 * by_place @ by_place.T
        y = miss.ravel()
        dense = np.linalg.slogdet(covariance)[1] + y @ np.linalg.solve(covariance, y)
        cost, left = system.solve(weight, factor2)
        np.testing.assert_allclose(left.ravel(), np.linalg.solve(covariance, y) / weight.ravel(), atol=1e-9)
        return cost - np.log(weight).sum(), dense

    (one, dense_one), (other, dense_other) = both(0.3, 1.0), both(1.7, 4.0)
    assert one - other == pytest.approx(dense_one - dense_other, abs=1e-8)


def searched(seed, shared=True, noise=TRUE):
    """Return objects as a search finds them, if all rays are matched rightly, with the true noise `TRUE`."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([6.0 * np.arange(60), np.zeros(60), np.zeros(60)])
    things = np.column_stack([rng.uniform(0, 360, 90), rng.choice([-7.0, 7.0], 90), np.zeros(90)])
    moment, owner = np.nonzero(np.linalg.norm(places[:, None] - things, axis=2) < 18)
    owner = np.unique(owner, return_inverse=True)[1]
    things = things[np.unique(np.nonzero(np.linalg.norm(places[:, None] - things, axis=2) < 18)[1])]
    error = PLACE * TRUE.place * rng.normal(size=(60 if shared else len(owner), 3)) * [1, 1, 0]
    error = error[moment] if shared else error
    to = things[owner] - places[moment]
    distance = np.linalg.norm(to, axis=1)
    bearing = np.arctan2(to[:, 1], to[:, 0]) + SIGMA * TRUE.rays * rng.normal(size=len(to))
    direction = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(len(to))])
    range_sigma = np.full(len(to), RANGE)
    measured = distance + RANGE * TRUE.ranges * rng.normal(size=len(to))
    found = FewRayEvidence(0.0, 0.0, 1.0, np.arange(len(to)), owner, moment, np.zeros((len(to), 3)), things)
    sigma = np.full(len(to), SIGMA)
    return Searched(noise, found, direction, to + error, np.zeros((len(to), 3)), sigma, measured, range_sigma, PLACE)


def test_the_noise_of_right_matches_is_found():
    start = SparseNoise(place=30.0, ranges=3.0, rays=2.0)
    found = [noise_of_residuals(searched(i, noise=start), (True, True, True), 1.0, shared=True) for i in range(4)]
    for name in ("place", "ranges", "rays"):
        assert np.mean([getattr(one, name) for one in found]) == pytest.approx(getattr(TRUE, name), rel=0.2), name


def test_the_noise_of_places_is_found_if_each_ray_has_its_own_error():
    start = SparseNoise(place=30.0, ranges=TRUE.ranges, rays=TRUE.rays)
    noises = [searched(i, shared=False, noise=start) for i in range(4)]
    found = [noise_of_residuals(one, (True, False, False), 1.0, shared=False).place for one in noises]
    assert np.mean(found) == pytest.approx(TRUE.place, rel=0.15)


def test_only_unknown_noise_changes():
    start = SparseNoise(place=30.0, ranges=3.0, rays=2.0)
    found = noise_of_residuals(searched(1, noise=start), (True, False, False), 1.0, shared=True)
    assert (found.ranges, found.rays) == (pytest.approx(3.0), pytest.approx(2.0))
    assert found.place > 40


def test_shared_errors_are_told_from_errors_of_each_ray():
    assert gain_of_shared_places(searched(2)) > 20
    assert gain_of_shared_places(searched(2, shared=False)) < -20
    nothing = FewRayEvidence(0.0, 0.0, 0.0, *np.zeros((3, 0), dtype=np.int64), *np.zeros((2, 0, 3)))
    empty = Searched(TRUE, nothing, *np.zeros((3, 0, 3)), *np.zeros((3, 0)), PLACE)
    assert gain_of_shared_places(empty) == 0


def test_corrected_places_tell_poles_of_a_street_apart():
    """Against the true poles, within 4 m, on streets with GPS noise of 1.9 to 2.9 m."""
    from association_parts.streets import street_counts

    counts = {False: np.zeros(4), True: np.zeros(4)}
    for seed in (0, 4, 7, 9, 10, 15):
        street = simulate_street(seed)
        for corrected, total in counts.items():
            found = search_objects(street.log, street.settings(True), SparseNoise(), correct_places=corrected).found
            total += street_counts(street, found.positions[:, :2])[0]
    (right, of, twice, poles), (better, of_better, twice_better, _) = counts[False], counts[True]
    assert better / of_better > right / of + 0.03
    assert twice_better / poles > twice / poles + 0.03
