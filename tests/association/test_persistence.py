"""The persistence filter against the recursion of the paper for any survival time, and what its limits are."""

import numpy as np

from objslam.association.persistence import LIFETIME, missed_by_all, persistence

LOOKS, MISSED, BY_CHANCE = 60, 0.03, 0.02


def rosen(times, found):
    """The filter of Rosen, Mason and Leonard (2016), section IV: the evidence is a sum over the time of disappearance."""

    def survives(t):
        return np.exp(-t / LIFETIME)

    likelihood, lower, before = 1.0, 0.0, 0.0
    for t, y in zip(times, found, strict=True):
        lower = (BY_CHANCE if y else 1 - BY_CHANCE) * (lower + likelihood * (survives(before) - survives(t)))
        likelihood *= 1 - MISSED if y else MISSED
        before = t
    evidence = lower + likelihood * survives(before)
    return likelihood * survives(before) / evidence


def test_the_filter_is_that_of_the_paper():
    rng, one = np.random.default_rng(0), np.ones(1, dtype=np.int64)
    for _ in range(20):
        times = np.cumsum(rng.uniform(0.2, 20, 12))
        found = rng.random(12) < 0.7
        p, before = np.ones(1), 0.0
        for k in range(12):
            p = persistence(p, np.array([times[k] - before]), found[[k]], LOOKS * one, 1000 * one, 900 * one)
            before = times[k]
            np.testing.assert_allclose(p[0], rosen(times[: k + 1], found[: k + 1]), rtol=1e-3, atol=1e-6)


def test_without_a_look_only_time_counts():
    nothing = np.zeros(1, dtype=np.int64)
    p = persistence(np.array([0.9]), np.array([10.0]), np.array([False]), nothing, nothing + 50, nothing + 40)
    np.testing.assert_allclose(p, 0.9 * np.exp(-10 / LIFETIME))


def test_more_looks_make_a_miss_weigh_more_down_to_a_floor():
    looks = np.array([1, 5, 20, 100, 1000])
    many, few = (
        persistence(np.full(5, 0.9), np.zeros(5), np.zeros(5, bool), looks, looks * 0 + 100, looks * 0 + d) for d in (80, 10)
    )
    assert (np.diff(many) <= 1e-12).all()
    assert (few >= many).all()  # What is rarely detected is easily missed.
    assert missed_by_all(looks, looks * 0 + 100, looks * 0 + 80)[-1] < 1e-4 < MISSED
    assert many[-1] == many[-2]
