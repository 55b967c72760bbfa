"""Errors that all objects of a map share: shift and yaw cost no evidence, and all are in the covariance of the result."""

import numpy as np
import pytest
from association.registration_scenes import SIGMA, bent, of, place, twins

from objslam.association.place_recognition import Constellation
from objslam.association.registration.map_registration import register_maps
from objslam.association.registration.shapes import shape_of
from objslam.core.geometry import lift_se2, split_se2
from objslam.core.maps.shared_covariance import jacobian

MOVED = np.diag([0.4, 0.3, 0.2, 0.0, 0.0, 0.03, 0.0]) ** 2  # A shift and a yaw: what a transform absorbs.
SHARED = np.diag([0.4, 0.3, 0.2, 0.008, 0.006, 0.03, 0.01]) ** 2


def with_part(one, shared):
    lever = jacobian(one.position)
    return Constellation(one.position, one.covariance + lever @ shared @ np.swapaxes(lever, 1, 2), one.label)


def error_of(found, truth):
    shift = found.b_T_a[:3, 3] - truth[:3, 3]
    return np.append(shift, split_se2(found.b_T_a @ np.linalg.inv(truth))[0][2])


@pytest.mark.parametrize("labels", [1, 4])
def test_a_shift_and_a_yaw_of_a_whole_map_cost_no_evidence(labels):
    """They change neither transform, matches nor odds. In the covariance of the transform they appear whole."""
    a, b, truth, _ = twins(np.random.default_rng(0), 25, labels, 0.9)
    plain = register_maps(a, b)
    found = register_maps(with_part(a, MOVED), with_part(b, MOVED), MOVED, MOVED)
    np.testing.assert_allclose(found.b_T_a, plain.b_T_a, atol=1e-9)
    np.testing.assert_array_equal(found.matches, plain.matches)
    assert found.log_odds == pytest.approx(plain.log_odds, abs=1e-6)
    assert found.log_odds > 20
    # By hand: an error (t, yaw) of map a turns with it, and a yaw of b also moves the origin of a, which is at `truth`.
    x, y = plain.b_T_a[:2, 3]
    of_a, of_b = np.eye(4), np.eye(4)
    of_a[:3, :3] = plain.b_T_a[:3, :3]
    of_b[0, 3], of_b[1, 3] = -y, x
    four = MOVED[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])]
    expected = plain.covariance + of_a @ four @ of_a.T + of_b @ four @ of_b.T
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-9)
    blind = register_maps(with_part(a, MOVED), with_part(b, MOVED))
    assert blind.log_odds < found.log_odds - 10  # The same maps, if their errors count as independent.
    assert np.abs(truth - found.b_T_a).max() < 1.0


def test_the_covariance_of_the_transform_is_that_of_maps_with_shared_errors():
    rng, squared = np.random.default_rng(1), []
    for _ in range(100):
        points, labels = place(rng, 20, 5)
        truth = lift_se2(rng.uniform(-3, 3, 3))
        there = points @ truth[:3, :3].T + truth[:3, 3]
        a, b = (bent(rng, of(p + rng.normal(0, SIGMA, p.shape), labels), SHARED) for p in (points, there))
        found = register_maps(a, b, SHARED, SHARED)
        assert len(found.matches) >= 10
        off = error_of(found, truth)
        squared.append(off @ np.linalg.solve(found.covariance, off))
    # The mean is 4 for 4 degrees of freedom, with a standard error of 0.28.
    assert 3.2 < np.mean(squared) < 4.8
    assert np.mean(np.array(squared) < 9.488) > 0.9


def test_the_variances_of_vectors_are_those_of_drawn_maps():
    """Length and rise between two objects, against 4,000 draws of all errors. Shift and yaw change neither."""
    rng = np.random.default_rng(2)
    points, own = rng.uniform(0, 8, (2, 3)), np.diag([0.03, 0.06, 0.02]) ** 2
    whole = with_part(Constellation(points, np.tile(own, (2, 1, 1)), np.zeros(2, dtype=np.int64)), SHARED)
    shape = shape_of(whole, np.arange(2), SHARED)
    one, other = np.array([0]), np.array([1])
    found = shape.vectors(one, other)
    drawn = rng.normal(size=(4000, 7)) @ np.sqrt(SHARED)
    at = points + np.einsum("nki,ri->rnk", jacobian(points), drawn) + rng.normal(size=(4000, 2, 3)) @ np.sqrt(own)
    base = at[:, 1] - at[:, 0]
    floor = 2 * 0.01**2  # Of the two objects, so that exact maps can be registered.
    assert found.length_variance[0] == pytest.approx(np.hypot(base[:, 0], base[:, 1]).var() + floor, rel=0.1)
    assert found.rise_variance[0] == pytest.approx(base[:, 2].var() + floor, rel=0.1)
    steady = shape_of(with_part(whole, MOVED), np.arange(2), SHARED + MOVED).vectors(one, other)
    np.testing.assert_allclose(steady.length_variance, found.length_variance)
    np.testing.assert_allclose(steady.rise_variance, found.rise_variance)


def test_different_places_with_shared_errors_are_refused():
    rng = np.random.default_rng(3)
    for _ in range(12):
        a, b = (bent(rng, of(*place(rng, int(rng.integers(10, 60)), 2)), SHARED) for _ in range(2))
        assert not register_maps(a, b, SHARED, SHARED).accepted


def test_rows_of_equal_objects_in_maps_of_uncertain_size_match_their_partners():
    """Five rows of three equal objects, 17 cm apart. A size that is 3 % wrong moves far objects by nearly as much."""
    rng, right = np.random.default_rng(4), []
    shared = np.diag(np.array([0.05, 0.05, 0, 0, 0, 0.02, 0.03]) ** 2)
    for own in np.repeat([0.02, 0.03], 40):
        turn, step = rng.uniform(0, np.pi, 5), 0.17 * (np.arange(3) - 1)
        rows = rng.uniform(-4, 4, (5, 1, 2)) + step[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)[:, None]
        points, spread = np.column_stack([rows.reshape(-1, 2), np.zeros(15)]), np.array([own, own, 0.01])
        covariance, label = np.tile(np.diag(spread**2), (15, 1, 1)), np.zeros(15, dtype=int)
        a, b = (
            bent(rng, Constellation(points + spread * rng.normal(size=points.shape), covariance, label), shared)
            for _ in range(2)
        )
        found = register_maps(a, b, shared, shared)
        if found.accepted:
            right.append(np.array_equal(found.matches[:, 0], found.matches[:, 1]))
    assert len(right) > 26
    assert np.mean(right) > 0.95, np.mean(right)  # 0.76 if the matches of each object are judged alone.
