"""The noise of ranges, by label, from residuals with known noise."""

import numpy as np
import pytest

from objslam.core.noise import LabelNoise, NoiseFactors
from objslam.graph.calibration.range_noise import RangeNoise

SIGMA, BIAS, EACH = 0.05, 0.1, 40  # m, m, and the number of ranges of each object.


def drawn(seed, objects, factors):
    """The nominal noise and the residuals of ranges. objects: (L,) how many objects a label has. factors: (2, L) the true
    factors on the noise of single ranges and on their bias."""
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(len(objects)), objects)
    owner = np.repeat(np.arange(len(label)), EACH)
    ranges, bias = np.asarray(factors)
    off = rng.normal(0, SIGMA * ranges[label[owner]]) + rng.normal(0, BIAS * bias[label])[owner]
    full = np.ones(len(owner))
    return RangeNoise(owner, label[owner], label, SIGMA * full, BIAS * full), off


def test_each_label_has_the_noise_of_its_ranges():
    """The ranges of the last of five labels end behind its things. They do not make those of the others worse."""
    true = np.array([[1, 1, 2, 1, 4], [1, 1, 1, 2, 8]])
    found = np.array([of.estimate(off, 5, 10.0)[2] for of, off in (drawn(seed, [60] * 5, true) for seed in range(20))])
    assert np.sqrt((found**2).mean(axis=0)) == pytest.approx(true, rel=0.08)


@pytest.mark.parametrize("wrong", [1.0, 10.0])
def test_a_label_with_wrong_ranges_is_no_part_of_the_noise_of_all(wrong):
    found = []
    for seed in range(40):
        of, off = drawn(seed, [3] * 8, [[1.0] * 7 + [wrong], [1.0] * 7 + [wrong]])
        ranges, bias, _ = of.estimate(off, 8, 10.0)
        found.append((ranges, bias))
    assert np.sqrt((np.array(found) ** 2).mean(axis=0)) == pytest.approx([1.0, 1.0], abs=0.2)


def test_a_label_with_one_object_has_the_noise_of_all():
    """One object tells nothing about its label: its place may be wrong instead of its ranges, or its rays are of two."""
    of, off = drawn(0, [5, 5, 5, 1], np.ones((2, 4)))
    off[of.owner == 15] += 10 * BIAS
    _, bias, factors = of.estimate(off, 4, 10.0)
    assert np.isnan(factors).tolist() == [[False, False, False, True]] * 2
    assert bias < 1.5


def test_names_have_the_mean_noise():
    """Where each label has one object, nothing tells a label with bad ranges from an object at a wrong place."""
    of, off = drawn(0, [1] * 12, np.ones((2, 12)))
    off[of.owner == 3] += 20 * BIAS
    _, bias, factors = of.estimate(off, 12, 10.0)
    middle = np.array([np.sort(off[of.owner == j])[EACH // 2] for j in range(12)])
    assert bias**2 == pytest.approx((4 + (middle**2).sum() / BIAS**2) / 16, rel=0.02)
    assert np.isnan(factors).all()


def test_ranges_without_a_second_of_their_object_tell_no_noise():
    once = np.arange(4)
    of = RangeNoise(once, np.zeros(4, dtype=int), np.zeros(4, dtype=int), np.full(4, SIGMA), np.full(4, BIAS))
    ranges, bias, factors = of.estimate(np.array([0.1, -0.2, 3.0, 0.0]), 1, 10.0)
    assert (ranges, bias) == (1.0, 1.0)
    assert np.isnan(factors).all()


def test_the_total_counts_the_bias_of_an_object_once():
    """n ranges with the total noise have the mean error of one bias and of n single errors."""
    of, _ = drawn(0, [1, 2], np.ones((2, 2)))
    total = of.total(np.array([[1.0, 2.0], [3.0, 0.5]]))
    expected = [SIGMA**2 / EACH + (3 * BIAS) ** 2, (2 * SIGMA) ** 2 / EACH + (0.5 * BIAS) ** 2]
    assert [total[of.owner == j] ** 2 / EACH for j in (0, 1)] == [pytest.approx(e) for e in expected]


def test_noise_is_like_another_only_with_the_same_labels():
    one = NoiseFactors(by_label=(LabelNoise("table", 2.0, 4.0),))
    assert one.like(NoiseFactors(by_label=(LabelNoise("table", 2.05, 3.9),)), 0.05)
    assert not one.like(NoiseFactors(by_label=(LabelNoise("table", 2.0, 3.0),)), 0.05)
    assert not one.like(NoiseFactors(), 0.05)
    assert NoiseFactors(by_label=(LabelNoise("cup", 1.0, 1.0),)).like(NoiseFactors(), 0.05)
    assert one.of_labels(("cup", "table")).tolist() == [[1.0, 2.0], [1.0, 4.0]]
    assert one.labels_to_dict() == {"table": {"ranges": 2.0, "range_bias": 4.0}}
