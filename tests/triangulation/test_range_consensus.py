"""Bearings that lead away from the ranges of their own object."""

import numpy as np
import pytest

from objslam.config import Triangulation
from objslam.core.arrays import Floats
from objslam.triangulation.triangulate import Triangulation as Found
from objslam.triangulation.triangulate import triangulate

THING = np.array([9.0, 1.0, 0.5])
SIGMA, RANGE_SIGMA = 0.005, 0.1


def seen(origins: Floats, to: Floats, seed: int) -> tuple[Floats, Floats]:
    """Bearings to a point with the noise SIGMA, and its distances with the noise RANGE_SIGMA."""
    rng = np.random.default_rng(seed)
    ray = to - origins
    distance = np.linalg.norm(ray, axis=1)
    return ray + rng.normal(0, SIGMA, ray.shape) * distance[:, None], distance + rng.normal(0, RANGE_SIGMA, len(distance))


def solved(origins: Floats, directions: Floats, ranges: Floats) -> Found:
    index = np.zeros(len(origins), dtype=int)
    return triangulate(origins, directions, index, 1, SIGMA, Triangulation(), ranges=ranges, range_sigma=RANGE_SIGMA)


def burst(number: int) -> Floats:
    """Places along half a metre of a drive."""
    return np.stack([np.linspace(0, 0.5, number), np.zeros(number), np.zeros(number)], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_a_misread_box_does_not_outweigh_the_ranges_of_all_others(seed: int) -> None:
    """Its bearing crosses four nearly parallel ones at 16 m. They were measured to be 9 m long."""
    origins = burst(4)
    directions, ranges = seen(origins, THING, seed)
    place = np.array([12.0, 12.0, 0.5])
    away = THING * 16 / 9
    found = solved(np.vstack([origins, place]), np.vstack([directions, away - place]), np.append(ranges, 3.5))
    assert found.ok[0]
    assert found.weight.tolist() == [1, 1, 1, 1, 0]
    sigma = np.sqrt(np.linalg.eigvalsh(found.covariance[0]).max())
    assert np.linalg.norm(found.positions[0] - THING) < 4 * sigma < 1.0
    alone = solved(origins, directions, ranges)
    assert np.allclose(found.positions[0], alone.positions[0], atol=1e-9)
    assert np.allclose(found.covariance[0], alone.covariance[0])


def test_depths_of_a_wall_do_not_outweigh_bearings_from_several_places() -> None:
    """A robot that stood measured the wall behind a thin thing a hundred times, and then saw the thing from other sides."""
    rng = np.random.default_rng(1)
    stood = rng.normal(0, 0.01, (100, 3))
    around = THING + 4 * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(1, 5, 30)])
    origins = np.vstack([stood, around])
    directions, _ = seen(origins, THING, 2)
    wall = np.append(np.full(100, 16.0), rng.uniform(6, 9, 30))
    found = solved(origins, directions, wall)
    assert found.ok[0]
    assert np.linalg.norm(found.positions[0] - THING) < 0.1


def test_ranges_that_agree_change_nothing() -> None:
    origins = np.vstack([burst(4), [[9.0, 6.0, 0.0]]])
    directions, ranges = seen(origins, THING, 3)
    found = solved(origins, directions, ranges)
    assert found.weight.all()
    assert np.linalg.norm(found.positions[0] - THING) < 0.2


def test_objects_beside_a_misread_one_stay_as_they_are() -> None:
    origins, other = burst(4), np.array([[0.0, 3, 0], [2, 5, 0], [4, 7, 0]])
    directions, ranges = seen(origins, THING, 0)
    to_other, to_ranges = seen(other, np.array([6.0, 2, 0]), 1)
    place = np.array([12.0, 12.0, 0.5])
    away = THING * 16 / 9 - place
    index = np.array([1, 1, 1, 0, 0, 0, 0, 0])
    both = triangulate(
        np.vstack([other, origins, place]),
        np.vstack([to_other, directions, away]),
        index,
        2,
        SIGMA,
        Triangulation(),
        ranges=np.concatenate([to_ranges, ranges, [3.5]]),
        range_sigma=RANGE_SIGMA,
    )
    alone = solved(other, to_other, to_ranges)
    assert np.allclose(both.positions[1], alone.positions[0], atol=1e-9)
    assert np.linalg.norm(both.positions[0] - THING) < 1.0
    assert both.counts.tolist() == [4, 3]
