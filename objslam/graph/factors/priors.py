"""Priors without a measurement: they fix the map frame and keep the linear system determined."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats
from objslam.graph.variables import L0, X0

ANCHOR = 1e-4
"""The standard deviation (rad, m) of the prior on the first keyframe. A larger value lets the whole map drift. A smaller
value conditions the linear system worse. This value is far below the noise of any measurement."""


def anchor(keyframe: int, map_T_camera: Floats) -> gtsam.NonlinearFactor:
    """Return the prior that holds X(keyframe) at a pose (4, 4). Bearings and odometry alone do not fix the map frame."""
    return pose_prior(keyframe, map_T_camera, ANCHOR, ANCHOR)


def point_prior(landmark: int, position: Floats, sigma: float) -> gtsam.NonlinearFactor:
    """Return a prior on L(landmark) at a position (3,), with a standard deviation (m) along each axis."""
    return gtsam.PriorFactorPoint3(L0 + landmark, position, gtsam.noiseModel.Isotropic.Sigma(3, sigma))


def pose_prior(keyframe: int, map_T_camera: Floats, turn: float, way: float) -> gtsam.NonlinearFactor:
    """Return a prior on X(keyframe) at a pose (4, 4), with standard deviations `turn` (rad) and `way` (m) for each axis."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn] * 3 + [way] * 3))
    return gtsam.PriorFactorPose3(X0 + keyframe, gtsam.Pose3(map_T_camera), noise)
