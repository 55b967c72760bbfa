"""The numbers of statistics: each is what its sentence says, and has no second home."""

import ast
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.special import expit
from scipy.stats import chi2, norm, rayleigh

import objslam
from objslam.core import statistics
from objslam.core.statistics import (
    binomial_tail,
    distinct,
    grouped_median,
    grouped_quantile,
    grouped_quantiles,
    grouped_visits,
    log_beta,
    logistic,
    noise_factors,
    order_by_group,
    poisson_tail,
    quantile,
)


def test_they_are_the_quantiles_that_they_say():
    assert pytest.approx(chi2.ppf(0.99, 3), rel=1e-4) == statistics.SAME_POINT
    assert pytest.approx(chi2.ppf(0.999, 3), rel=1e-4) == statistics.SAME_POINT_WIDE
    assert pytest.approx(chi2.ppf(norm.cdf(3) - norm.cdf(-3), 3), rel=1e-4) == statistics.POSSIBLE_MOTION
    assert pytest.approx(chi2.ppf(0.999, 2), rel=1e-4) == statistics.STRAY_RAY
    assert pytest.approx(rayleigh.sf(statistics.OUTLIER_RAY), rel=0.15) == 3e-4
    assert pytest.approx(rayleigh.median()) == statistics.RAYLEIGH_MEDIAN
    assert pytest.approx(rayleigh.mean()) == statistics.RAYLEIGH_MEAN
    assert pytest.approx(norm.ppf(0.75), rel=1e-4) == statistics.NORMAL_MEDIAN


def test_a_robust_loss_is_95_percent_efficient_on_gaussian_noise():
    """The asymptotic efficiency of an M-estimator of a place: E[psi']^2 / E[psi^2]."""
    x = np.linspace(-12, 12, 200_001)
    density = norm.pdf(x) * (x[1] - x[0])
    k, c = statistics.HUBER_K, statistics.CAUCHY_K
    for psi in (np.clip(x, -k, k), x / (1 + (x / c) ** 2)):
        slope = (np.gradient(psi, x) * density).sum()
        assert slope**2 / (psi**2 * density).sum() == pytest.approx(0.95, abs=1e-3)


def floats(module: Path) -> Iterator[float]:
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
            yield node.value


def test_they_stand_nowhere_else():
    """Round numbers may mean many things; the others are these, to half a percent."""
    numbers = {name: x for name, x in vars(statistics).items() if isinstance(x, float) and x % 1}
    ours = [x for name, x in numbers.items() if name != "RAYLEIGH_MEAN"]  # which is close to 1.25
    package = Path(objslam.__file__).parent
    others = [module for module in sorted(package.rglob("*.py")) if module.stem != "statistics"]
    assert len(ours) == 8
    assert [(module.stem, x) for module in others for x in floats(module) if np.isclose(x, ours, rtol=5e-3).any()] == []


@given(st.lists(st.tuples(st.integers(0, 4), st.floats(-1e6, 1e6)), max_size=60), st.floats(0, 1))
def test_quantiles_of_groups(pairs, share):
    index = np.array([i for i, _ in pairs], dtype=np.int64)
    values = np.array([x for _, x in pairs])
    quantile, median = grouped_quantile(values, index, 5, share), grouped_median(values, index, 5)
    for group in range(5):
        mine = np.sort(values[index == group])
        if not len(mine):
            assert np.isnan(quantile[group])
            assert np.isnan(median[group])
            continue
        assert quantile[group] == mine[min(int(share * len(mine)), len(mine) - 1)]
        assert median[group] == mine[len(mine) // 2]


@pytest.mark.parametrize("count", [1, 7, 1 << 16, (1 << 16) + 1, 1 << 20])
def test_members_of_a_group_come_together_in_their_order(count):
    index = np.random.default_rng(0).integers(count, size=5_000)
    index[:2] = count - 1
    assert order_by_group(index, count).tolist() == sorted(range(5_000), key=lambda i: (index[i], i))


@given(npst.arrays(np.int64, st.integers(0, 50), elements=st.integers(-5, 5) | st.integers(-(1 << 62), 1 << 62)))
def test_different_values(values):
    assert distinct(values).tolist() == sorted(set(values.tolist()))


def test_the_noise_of_each_group_is_that_of_its_median_ray():
    rng = np.random.default_rng(0)
    factor = np.repeat([0.5, 1.0, 3.0, 3.0], [500, 500, 500, 3])
    index = np.repeat([0, 1, 2, 3], [500, 500, 500, 3])
    deviations = factor * np.hypot(*rng.normal(size=(2, len(index))))
    deviations[500:600] = 100.0  # a fifth of one group fits nothing
    found = noise_factors(deviations, index, 5, fewest=6)
    np.testing.assert_allclose(found, [1.0, 1.1, 3.0, 1.0, 1.0], atol=0.2)


def test_the_poisson_tail_of_a_large_mean_is_one():
    """The first term is 0 in floating point, and the ratios of the terms are too large for it."""
    with np.errstate(all="raise", under="ignore", divide="ignore"):
        np.testing.assert_allclose(poisson_tail(np.array([1, 3]), np.array([5000.0, 900.0])), 1.0, rtol=1e-14)


def test_the_poisson_tail_is_one_less_the_sum_of_the_smaller_counts():
    least, mean = np.array([-2, 0, 1, 2, 5, 3]), np.array([1.0, 0.0, 0.5, 3.0, 2.0, 0.0])
    expected = [1 - sum(math.exp(-m) * m**k / math.factorial(k) for k in range(n)) for n, m in zip(least, mean, strict=True)]
    np.testing.assert_allclose(poisson_tail(least, mean), expected, atol=1e-15)


def test_the_binomial_tail_is_the_sum_of_its_counts():
    for share in (0.1, 0.5, 0.97):
        number, least = np.meshgrid(np.arange(12), np.arange(-1, 14))
        expected = [
            sum(math.comb(n, k) * share**k * (1 - share) ** (n - k) for k in range(max(m, 0), n + 1))
            for n, m in zip(number.ravel().tolist(), least.ravel().tolist(), strict=True)
        ]
        np.testing.assert_allclose(binomial_tail(least, number, share).ravel(), expected, rtol=1e-12)
    assert binomial_tail(np.array(90), np.array(90), 0.01) == pytest.approx(1e-180, rel=1e-10)


def test_sums_and_scipy_give_the_same_special_functions(monkeypatch):
    rng = np.random.default_rng(0)
    mean = np.exp(rng.uniform(-8, 6, 200))
    least = np.maximum(np.round(mean + rng.normal(size=200) * 3 * np.sqrt(mean) + rng.integers(-2, 8, 200)), 0).astype(int)
    a, b = np.exp(rng.uniform(-3, 8, (2, 200)))
    number = rng.integers(0, 90, 200)
    few = rng.integers(-2, 90, 200)
    summed = poisson_tail(least, mean), log_beta(a, b), binomial_tail(few, number, 0.2)
    monkeypatch.setattr(statistics, "_FEW", 0)
    np.testing.assert_allclose(summed[0], poisson_tail(least, mean), rtol=1e-11)
    np.testing.assert_allclose(summed[1], log_beta(a, b), atol=1e-10)
    np.testing.assert_allclose(summed[2], binomial_tail(few, number, 0.2), rtol=1e-11)


def test_log_odds_become_probabilities_however_large_they_are():
    odds = np.array([-1e4, -800.0, -30.0, -1.0, 0.0, 2.5, 40.0, 1e4, -np.inf, np.inf])
    np.testing.assert_allclose(logistic(odds), expit(odds), rtol=1e-13, atol=1e-300)


@given(npst.arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e3, 1e3)), st.floats(0, 1))
def test_a_quantile_is_that_of_numpy(values, share):
    assert quantile(values, share) == pytest.approx(np.quantile(values, share), abs=1e-9)


def test_quantiles_of_large_groups_are_those_of_sorted_groups():
    """Groups of 3 to 600 values, one empty, so that some calls partition and others sort."""
    rng = np.random.default_rng(4)
    for size in (10, 1800):
        index = rng.choice([0, 1, 1, 3], size)
        values = np.where(rng.random(size) < 0.02, np.nan, rng.normal(size=size).round(1))
        shares = (0.0, 0.5, 0.95, 1.0)
        for share, found in zip(shares, grouped_quantiles(values, index, 4, shares), strict=True):
            for group, one in enumerate(found.tolist()):
                mine = np.sort(values[index == group])
                expected = mine[min(int(share * len(mine)), len(mine) - 1)] if len(mine) else np.nan
                np.testing.assert_array_equal(one, expected)


def test_visits_end_at_gaps_and_belong_to_one_object():
    stamps, index = np.array([9.0, 0.0, 1.0, 5.0, 1.5, 3.5]), np.array([2, 0, 2, 0, 0, 2])
    visit = grouped_visits(stamps, index, 3.0)
    together = [sorted(np.flatnonzero(visit == number).tolist()) for number in np.unique(visit)]
    assert together == [[1, 4], [3], [2, 5], [0]]  # A gap of 3 s ends no visit, and one of 3.5 s does.
    assert len(grouped_visits(np.zeros(0), np.zeros(0, dtype=np.int64), 3.0)) == 0
