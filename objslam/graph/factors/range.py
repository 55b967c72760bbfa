"""Factors for the measured range of a box, and their noise. The camera pose is a variable or fixed."""

from dataclasses import replace

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Association, Rays
from objslam.graph.factors.noise import Noise, huber
from objslam.graph.variables import L0, X0


def ranges(
    keyframe: Ints, measured: Floats, landmark: Ints, noise: Noise, offset: Floats | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return one factor for each of the distances `measured` (R,), m, between X(keyframe) and L(landmark).

    offset: (R, 3) m, the point from which each distance was measured, in the frame of X(keyframe). None means the origin.
    """
    columns = (keyframe.tolist(), landmark.tolist(), measured.tolist(), noise)
    if offset is None:
        return [gtsam.RangeFactor3D(X0 + k, L0 + j, r, model) for k, j, r, model in zip(*columns, strict=True)]
    level = gtsam.Rot3()
    return [
        gtsam.RangeFactorWithTransform3D(X0 + k, L0 + j, r, model, gtsam.Pose3(level, at))
        for k, j, r, model, at in zip(*columns, offset, strict=True)
    ]


def along_ray(
    origins: Floats, directions: Floats, measured: Floats, sigmas: Floats, landmark: Ints
) -> list[gtsam.NonlinearFactor]:
    """Return one factor with Huber's loss for each of the ranges `measured` (R,), m, of landmarks along fixed rays.

    Origins (R, 3), m, and unit directions (R, 3) are in map. sigmas: (R,) m, the standard deviations of the ranges. A factor
    does not restrict the landmark across its ray.
    """
    points = origins + directions * measured[:, None]
    roots = np.zeros((len(points), 3, 3))
    roots[:, 0] = directions / sigmas[:, None]
    make = gtsam.noiseModel.Gaussian.SqrtInformation
    return [
        gtsam.PriorFactorPoint3(L0 + j, point, huber(make(root)))
        for j, point, root in zip(landmark.tolist(), points, roots, strict=True)
    ]


def share_bias(rays: Rays, association: Association) -> Rays:
    """Return the rays with larger noise of ranges, which accounts for the bias that all ranges of an object share."""
    # If n ranges have noise s and share a bias b, their mean has the variance b^2 + s^2 / n. The mean of n independent
    # ranges with the variance s^2 + n b^2 has the same variance.
    ranged = np.isfinite(rays.range) & (association.object >= 0)
    number = np.bincount(association.object[ranged], minlength=association.count)
    sigma = rays.range_sigma.copy()
    sigma[ranged] = np.sqrt(sigma[ranged] ** 2 + number[association.object[ranged]] * rays.range_bias[ranged] ** 2)
    return replace(rays, range_sigma=sigma)
