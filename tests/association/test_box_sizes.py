"""What the boxes of a thing usually measure, and what it costs a box to measure something else."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import watch

from objslam.association.gating import gate_limit
from objslam.association.observations import SIZE_LOSS, Observations, UsualSizes
from objslam.config import Settings
from objslam.core.geometry import lift_se2
from objslam.simulation import make_camera

SIGMA = 0.004
GATE = gate_limit(Settings().association.gate)


def boxes(size, range_=np.nan):
    """Observations of boxes with sizes (R, 2) m per m of their distance, and with one range, m, of 10 %."""
    count = len(size)
    ranges = np.full(count, range_)
    lines = Observations.of_lines(
        np.zeros((count, 3)), np.tile([1.0, 0, 0], (count, 1)), np.full(count, SIGMA), ranges, 0.1 * ranges
    )
    return replace(lines, size=np.asarray(size, dtype=float))


def usual(size, number=30, spread=0.0):
    """The usual size of one thing of `size`, (2,) m, seen from 1 to 5 m. spread: the deviation of ln size."""
    rng = np.random.default_rng(0)
    distance = rng.uniform(1.0, 5.0, number)
    measured = np.asarray(size) * np.exp(spread * rng.standard_normal((number, 2))) / distance[:, None]
    return UsualSizes.of(measured, distance, np.zeros(number, dtype=np.int64), 1)


def cost(of, size, distance, sigma=0.0, range_=np.nan):
    """The cost of one box of a thing of `size`, m, at a distance, m."""
    zero = np.zeros(1, dtype=np.int64)
    seen = boxes(np.asarray(size)[None] / distance, range_)
    return float(of.costs(seen, zero, zero, np.array([distance]), np.array([sigma]))[0])


def test_the_size_of_each_landmark_is_that_of_its_boxes():
    rng, owner = np.random.default_rng(0), np.repeat([2, 0], [4000, 3000])
    true = np.array([[0.2, 0.5], [np.nan, np.nan], [1.0, 0.3]])
    distance = rng.uniform(1.0, 6.0, len(owner))
    size = true[owner] * np.exp(0.1 * rng.standard_normal((len(owner), 2))) / distance[:, None]
    size[::5, 1] = 0.0  # These cameras see no sizes.
    found = UsualSizes.of(size, distance, owner, 3)
    np.testing.assert_array_equal(found.number, np.bincount(owner[(size > 0).all(axis=1)], minlength=3))
    np.testing.assert_allclose(np.exp(found.ln_size[[0, 2]]), true[[0, 2]], rtol=0.02)
    np.testing.assert_allclose(found.variance[[0, 2]], 0.1**2, rtol=0.1)
    one = found.take(np.array([2]))
    assert (one.number[0], *one.ln_size[0]) == (found.number[2], *found.ln_size[2])


def test_a_box_of_the_usual_size_costs_nothing_and_one_of_another_size_much():
    known = usual((0.2, 0.4), number=1000, spread=0.1)
    for distance in (1.0, 4.0):
        assert cost(known, (0.2, 0.4), distance) == 0.0
        assert cost(known, (0.23, 0.36), distance) == 0.0
        assert cost(known, (0.6, 1.2), distance) == SIZE_LOSS
        assert cost(known, (0.07, 0.13), distance) == SIZE_LOSS
    costs = [cost(known, (0.2 * factor, 0.4 * factor), 2.0) for factor in (1.2, 1.27, 1.29, 1.6)]
    assert costs == sorted(costs)
    assert 0 < costs[1] < SIZE_LOSS


def test_a_larger_box_with_a_shorter_range_is_of_a_nearer_thing():
    known = usual((0.2, 0.4), number=1000, spread=0.1)
    for distance in (1.0, 4.0):
        assert cost(known, (0.6, 1.2), distance, range_=distance / 3) > 2 * GATE
        assert cost(known, (0.6, 1.2), distance, range_=distance) == SIZE_LOSS  # A detector's mistake.
        assert cost(known, (0.6, 0.4), distance, range_=distance / 3) == SIZE_LOSS  # Two things side by side.
        assert cost(known, (0.07, 0.13), distance, range_=distance / 3) == SIZE_LOSS  # A half hidden thing.


def test_the_deviation_counts_in_its_variances():
    """Chi-squared of two sizes, beyond its 95 % quantile: the spread, the noise of two edges, and that of the distance."""
    known, distance, sigma = usual((0.5, 0.5), number=1000, spread=0.2), 4.0, 0.6
    size = 0.5 * 1.7
    variance = known.variance[0] + (2 * SIGMA / (size / distance)) ** 2 + (sigma / distance) ** 2
    expected = ((np.log(size) - known.ln_size[0]) ** 2 / variance).sum() - 5.991
    assert 0 < expected < SIZE_LOSS
    assert cost(known, (size, size), distance, sigma) == pytest.approx(expected, abs=0.01)


def test_what_is_not_known_costs_nothing():
    assert cost(usual((0.2, 0.4), number=4), (0.8, 1.6), 2.0) == 0.0  # Four boxes are too few.
    assert cost(usual((0.2, 0.4), number=5), (0.8, 1.6), 2.0) > 0.0
    assert cost(usual((0.2, 0.4)), (0.0, 0.4), 2.0) == 0.0
    assert cost(usual((0.2, 0.4)), (0.5, 1.0), 2.0, sigma=2.0) == 0.0  # Half as far away, the thing is as large as usual.
    assert cost(usual((0.2, 0.4)), (0.5, 1.0), 2.0) > 0.0


def test_the_box_of_a_nearer_thing_on_the_same_line_of_sight_is_not_of_the_landmark():
    """A robot with ranges passes one post, and then sees a nearer, equal post once, in the direction of the first one."""
    way = np.column_stack([np.linspace(-4.0, 2.0, 40), np.zeros((40, 2))])
    poses = lift_se2(np.vstack([way, [4.0, -6.0, np.pi / 2]]))
    camera, post = (poses[-1] @ make_camera().base_T_camera)[:3, 3], np.array([4.0, 1.0, 0.45])
    scene = watch(np.array([post, (post + camera) / 2]), poses)
    seen = np.flatnonzero(scene.whose == (scene.rays.keyframe == len(way)))
    rays, whose = scene.rays.take(seen), scene.whose[seen]
    camera = scene.keyframes.map_T_camera[rays.keyframe, :3, 3]
    away = np.linalg.norm(scene.points[whose] - camera, axis=1)
    scene = replace(scene, rays=replace(rays, range=away, range_sigma=0.1 * away), whose=whose)
    assert (np.bincount(scene.whose) == [40, 1]).all()
    found = scene.associate().object
    np.testing.assert_array_equal(found, np.where(scene.whose == 0, 0, -1))
