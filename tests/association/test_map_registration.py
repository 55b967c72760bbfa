"""Maps in unknown frames: the same place is registered, another place is refused, and a repeated place is ambiguous."""

import numpy as np
import pytest
from association.registration_scenes import SIGMA, errors, groups, of, place, rooms, twins

from objslam.association.registration.map_registration import register_maps
from objslam.core.geometry import align


@pytest.mark.parametrize(("count", "labels"), [(12, 3), (20, 10), (60, 3), (150, 6)])
@pytest.mark.parametrize("overlap", [0.5, 1.0])
def test_maps_of_one_place_are_registered(count, labels, overlap):
    rng = np.random.default_rng(count + labels)
    for _ in range(20):  # Small maps that overlap little may share too few objects.
        a, b, truth, shared = twins(rng, count, labels, overlap)
        if len(shared) >= 7:
            break
    found = register_maps(a, b)
    assert found.accepted
    shift, turn = errors(found.b_T_a, truth, a.position[shared[:, 0]])
    known = align(a.position[shared[:, 0]], b.position[shared[:, 1]], "se2")[0]  # The best that the noise allows.
    best_shift, best_turn = errors(known, truth, a.position[shared[:, 0]])
    assert shift < max(0.1, 1.2 * best_shift)
    assert turn < max(np.radians(1), 1.2 * best_turn)
    pairs = set(map(tuple, shared.tolist()))
    assert len(pairs & set(map(tuple, found.matches.tolist()))) >= 0.9 * len(pairs)
    np.testing.assert_array_equal(a.label[found.matches[:, 0]], b.label[found.matches[:, 1]])


def test_proposals_that_are_compared_in_parts_give_the_same_transform(monkeypatch):
    a, b, *_ = twins(np.random.default_rng(0), 25, 4, 0.9)
    found = []
    for at_once in (1 << 30, 1000):
        monkeypatch.setattr("objslam.association.registration.proposals._AT_ONCE", at_once)
        found.append(register_maps(a, b))
    np.testing.assert_array_equal(found[0].b_T_a, found[1].b_T_a)
    np.testing.assert_array_equal(found[0].matches, found[1].matches)
    assert found[0].log_odds == found[1].log_odds


def test_maps_of_different_places_are_refused():
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = of(*place(rng, int(rng.integers(10, 80)), 3)), of(*place(rng, int(rng.integers(10, 80)), 3))
        assert not register_maps(a, b).accepted


def test_groups_of_equal_objects_give_no_false_evidence():
    """Log odds of x come by chance in at most exp(-x) of the pairs of different places, 13 % for 2."""
    rng = np.random.default_rng(5)
    odds = [register_maps(*(groups(rng, 10, 5, 6) for _ in range(2))).log_odds for _ in range(12)]
    assert np.mean(np.array(odds) > 2) <= 0.135


def test_objects_that_agree_closely_are_more_evidence():
    """Fifteen objects without names, each off by 2.6 standard deviations, or by 1. Both are inside the gates."""
    rng, odds = np.random.default_rng(6), []
    for _ in range(6):
        points, labels = place(rng, 15, 1)
        off = rng.normal(size=points.shape)
        off *= np.sqrt(2) * SIGMA / np.linalg.norm(off, axis=1)[:, None]
        odds.append([register_maps(of(points, labels), of(points + part * off, labels)).log_odds for part in (2.6, 1.0)])
    far, close = np.median(odds, axis=0)
    assert far > 9.2
    assert close > far + 6


@pytest.mark.parametrize("seed", range(3))
def test_a_room_among_three_equal_ones_is_ambiguous(seed):
    points, labels, three, of_three = rooms(np.random.default_rng(seed))
    found = register_maps(of(points, labels), of(three, of_three))
    assert found.verdict == "ambiguous"
    assert not found.accepted
    assert found.second_b_T_a is not None
    apart = np.linalg.norm(found.second_b_T_a[:3, 3] - found.b_T_a[:3, 3])
    assert min(abs(apart - 8), abs(apart - 16)) < 0.3
    alone = register_maps(of(points, labels), of(three[:12], labels))
    assert alone.accepted  # Without its copies, the same room is evidence enough.


def test_the_covariance_is_that_of_repeated_measurements():
    rng = np.random.default_rng(2)
    points, labels = place(rng, 25, 5)
    normalised = []
    for _ in range(30):
        a, b = (of(points + rng.normal(0, SIGMA, points.shape), labels) for _ in range(2))
        found = register_maps(a, b)
        off = np.append(found.b_T_a[:3, 3], np.arctan2(found.b_T_a[1, 0], found.b_T_a[0, 0]))
        normalised.append(off @ np.linalg.solve(found.covariance, off))
    assert 2.5 < np.mean(normalised) < 6.0  # The mean is 4 for 4 degrees of freedom, with a standard error of 0.5.


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_objects_are_refused(count):
    rng = np.random.default_rng(0)
    points, labels = place(rng, 10, 2)
    found = register_maps(of(points[:count], labels[:count]), of(points, labels))
    assert found.verdict == "too little evidence"
    assert len(found.matches) <= count
