"""Factors between the frame of a drive and the frame of an older map."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.graph.factors.noise import huber
from objslam.graph.variables import L0

F0 = gtsam.symbol("f", 0)
"""The key of the pose map_T_drive, the frame of the drive in the map."""
P0 = gtsam.symbol("p", 0)
"""The key of P(0), the true position of object 0 in the map. The key of P(j) is P0 + j."""
_UPRIGHT = 1e-5
"""The standard deviation (rad) of roll and pitch between two frames with z up. A larger value lets frames tilt. This value
is far below any tilt that a map can show, and keeps the linear system well conditioned."""
_FREE = 100.0
"""The standard deviation (rad, m) of the yaw and the shift of a frame in its prior. A larger value leaves more freedom, and
conditions the linear system worse."""


def frame_prior(map_T_drive: Floats) -> gtsam.NonlinearFactor:
    """Return the prior on F at map_T_drive (4, 4). It fixes roll and pitch, and leaves yaw and shift nearly free."""
    sigmas = np.array([_UPRIGHT, _UPRIGHT, _FREE, _FREE, _FREE, _FREE])
    return gtsam.PriorFactorPose3(F0, gtsam.Pose3(map_T_drive), gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def own_errors(objects: Ints, covariance: Floats) -> list[gtsam.NonlinearFactor]:
    """Return one factor for each of the objects (n,), which says that F * L(j) = P(j).

    covariance: (n, 3, 3) m^2, the covariance of the difference of the two sides, in map.
    """
    make = gtsam.noiseModel.Gaussian.Covariance
    return [
        gtsam.ReferenceFrameFactorPoint3Pose3(L0 + j, F0, P0 + j, make(c))
        for j, c in zip(objects.tolist(), covariance, strict=True)
    ]


def object_priors(
    first: int, objects: Ints, position: Floats, covariance: Floats, *, robust: bool
) -> list[gtsam.NonlinearFactor]:
    """Return a prior with mean (n, 3) m and covariance (n, 3, 3) m^2 on the points of objects (n,).

    first: the key of the point of object 0. robust: whether the priors have Huber's loss.
    """
    make = gtsam.noiseModel.Gaussian.Covariance
    return [
        gtsam.PriorFactorPoint3(first + j, point, huber(make(c)) if robust else make(c))
        for j, point, c in zip(objects.tolist(), position, covariance, strict=True)
    ]
