"""Two things of one label that are never seen together, and whose rays cross between them."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import watch

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2

POINTS = np.array([[1.3, 0.1, 0.45], [-1.5, -0.1, 0.40], [2.9, 1.9, 0.4], [-3.2, 0.9, 0.5]])
LABELS = np.array([0, 0, 1, 1])


def figure_eight(count: int = 250) -> Floats:
    """Robot poses (count, 4, 4) along a figure eight of 15 m, at one speed."""
    angle = np.linspace(0, 2 * np.pi, 20001)
    way = np.column_stack([2.4 * np.sin(angle), 1.5 * np.sin(2 * angle)])
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    way *= 15.0 / length[-1]
    step = np.gradient(way, axis=0)
    at = np.linspace(0, length[-1], count)
    heading = np.interp(at, length, np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    return lift_se2(np.column_stack([np.interp(at, length, way[:, 0]), np.interp(at, length, way[:, 1]), heading]))


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_things_are_found_where_the_rays_to_both_cross_too(seed: int) -> None:
    """The allowance for errors of poses and cameras is four times the noise of the boxes, as in a first association."""
    scene = watch(POINTS, figure_eight(), label=LABELS, names=("mug", "bottle"), missed=0.1, pixel_sigma=1.5, seed=seed)
    rays = replace(scene.rays, sigma=4 * scene.rays.sigma)
    association = scene.associate(rays=rays, position_sigma=0.02)
    found, true, _ = scene.compare(association, radius=0.3)
    assert association.count == len(found)
    assert set(true) >= {0, 1}
