"""Add the squares of fiducials to a graph: the ties of their corners, their poses and their sizes."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import make_pose
from objslam.graph.factors.tags import tag_ties
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.shapes import squares_of
from objslam.graph.variables import TAG0, TAG_SIZE0


def add_squares(
    tags: TagCorners, landmarks: Ints, positions: Floats, values: gtsam.Values, prior_sigma: float
) -> list[gtsam.NonlinearFactor]:
    """Return the ties of the fiducials whose corners are all in the graph, and add their poses and sizes to the values.

    landmarks: (m,) the landmarks in the graph. positions: (M, 3) m of all landmarks. prior_sigma: the standard deviation (m)
    of half the diagonal of a fiducial with an unknown side.
    """
    which = tags.tied(landmarks)
    rotation, centre, side = squares_of(positions[tags.landmarks[which]], tags.shape[which])
    for t, pose in zip(which.tolist(), make_pose(rotation, centre), strict=True):
        values.insert(TAG0 + t, gtsam.Pose3(pose))
    for t in which[np.isnan(tags.side[which])].tolist():
        values.insert(TAG_SIZE0 + t, 0.0)
    return tag_ties(which, tags.landmarks[which], tags.shape[which], tags.side[which], side, prior_sigma)
