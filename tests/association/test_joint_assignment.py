"""Joint assignment: against all hypotheses, and with errors that all pairings share."""

import itertools

import numpy as np
from scipy.stats import multivariate_normal

from objslam.association.joint_assignment import Pairings, assign_jointly

GATE = 16.266


def pairings(row, column, residual, covariance, rarity):
    return Pairings(np.array(row), np.array(column), residual, covariance, np.full(len(row), rarity), GATE)


def shared(residual, common, own):
    """Residuals (P, D) with one error that all share (standard deviation `common`) and their own."""
    count, dimension = residual.shape
    covariance = np.zeros((count, dimension, count, dimension))
    for d in range(dimension):
        covariance[:, d, :, d] = common**2 + own**2 * np.eye(count)
    return covariance


def best_of_all(p):
    """The best log odds over all sets of pairings that use a row and a column once."""
    best = 0.0
    for size in range(1, len(p.row) + 1):
        for chosen in map(list, itertools.combinations(range(len(p.row)), size)):
            if len(set(p.row[chosen])) < size or len(set(p.column[chosen])) < size:
                continue
            block = p.covariance[np.ix_(chosen, range(2), chosen, range(2))].reshape(2 * size, -1)
            density = multivariate_normal(np.zeros(2 * size), block).logpdf(p.residual[chosen].ravel())
            best = max(best, density + p.rarity[chosen].sum())
    return best


def test_the_odds_are_those_of_the_best_of_all_hypotheses():
    rng = np.random.default_rng(0)
    for _ in range(40):
        row, column = np.divmod(np.arange(9), 3)
        places = rng.uniform(-0.6, 0.6, (3, 2))
        shift = 0.3 * rng.standard_normal(2)
        seen = places + shift + 0.02 * rng.standard_normal((3, 2))
        residual = seen[row] - places[column]
        found = assign_jointly(pairings(row, column, residual, shared(residual, 0.3, 0.03), 2.0))
        assert found.odds <= best_of_all(pairings(row, column, residual, shared(residual, 0.3, 0.03), 2.0)) + 1e-9
        right = residual[[0, 4, 8]]
        truth = shared(right, 0.3, 0.03).reshape(6, 6)
        assert found.odds >= multivariate_normal(np.zeros(6), truth).logpdf(right.ravel()) + 6.0 - 1e-9


def test_margins_of_pairings_without_rivals_are_those_over_all_hypotheses():
    rng = np.random.default_rng(1)
    compared = 0
    for _ in range(40):
        residual = 0.3 * rng.standard_normal(2) + 0.03 * rng.standard_normal((4, 2))
        every = pairings(range(4), range(4), residual, shared(residual, 0.3, 0.03), 2.0)
        found = assign_jointly(every)
        assert found.odds <= best_of_all(every) + 1e-9
        if len(found.chosen) < 4:
            continue
        assert found.odds >= best_of_all(every) - 1e-9
        for i, margin in zip(found.chosen.tolist(), found.margin, strict=True):
            kept = [n for n in range(4) if n != i]
            others = pairings(kept, kept, residual[kept], shared(residual[kept], 0.3, 0.03), 2.0)
            np.testing.assert_allclose(margin, found.odds - best_of_all(others), atol=1e-9)
        assert not found.rival.any()
        compared += 1
    assert compared > 20


def test_one_common_error_is_no_hindrance_and_different_errors_are():
    """Two residuals of 3 standard deviations: in one direction they are one error of the pose, else one is wrong."""
    same, opposite = np.array([[0.3, 0.0], [0.3, 0.0]]), np.array([[0.3, 0.0], [-0.3, 0.0]])
    together = assign_jointly(pairings([0, 1], [0, 1], same, shared(same, 0.1, 0.02), 8.0))
    assert sorted(together.chosen) == [0, 1]
    apart = assign_jointly(pairings([0, 1], [0, 1], opposite, shared(opposite, 0.1, 0.02), 8.0))
    assert len(apart.chosen) == 1


def test_the_margin_of_one_of_two_equal_landmarks_is_none():
    residual = np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.0]])
    found = assign_jointly(pairings([0, 0, 1], [0, 1, 2], residual, shared(residual, 0.0, 0.1), 5.0))
    of = dict(zip(found.chosen.tolist(), zip(found.margin, found.rival, strict=True), strict=True))
    sure = of.pop(2)
    (doubtful,) = of.values()
    assert doubtful[0] < 1e-9
    assert doubtful[1]
    assert sure[0] > 5.0
    assert not sure[1]


def test_without_a_pairing_inside_the_gate_everything_is_new():
    residual = np.array([[1.0, 0.0]])
    found = assign_jointly(pairings([0], [0], residual, shared(residual, 0.0, 0.1), 100.0))
    assert len(found.chosen) == 0
    assert found.odds == 0.0
    assert len(assign_jointly(pairings([], [], np.zeros((0, 2)), np.zeros((0, 2, 0, 2)), 1.0)).chosen) == 0
