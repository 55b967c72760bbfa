"""Bodies of things that were seen from one side: the best cuboid is found, and the sigmas hold what boxes do not tell."""

import numpy as np
from triangulation.true_boxes import CAMERAS, boxes_of_outlines, corners_of, inside, solved

MANY = 40


def seen_over(arc):
    """Cuboids of 0.3 to 0.6 m seen over an arc, rad. Their bodies, and the errors (MANY, 3) of the centres, m."""
    rng = np.random.default_rng(8)
    half = rng.uniform(0.15, 0.3, (MANY, 3))
    boxes, poses = boxes_of_outlines(CAMERAS["pinhole"], [corners_of(h, rng.uniform(0, 3)) for h in half], rng, 24, arc)
    true = np.column_stack([np.zeros((MANY, 2)), half[:, 2]])
    found = solved(CAMERAS["pinhole"], boxes, poses, true + rng.normal(0, 0.05, true.shape), half[:, [0, 2]])
    return found, found.axes[:, :3] - true


def test_the_cuboid_of_another_heading_and_depth_is_found():
    """The fit ended at a cuboid of a wrong heading, up to 0.1 m too near or too far, which is far less probable."""
    found, off = seen_over(np.radians(30))
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.025
    assert inside(off, found.centre_covariance) >= 0.92
