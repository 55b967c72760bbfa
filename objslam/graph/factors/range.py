"""The distance that came with a box: from a pose that is solved, or along a ray whose pose is known."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.graph.factors.noise import huber
from objslam.graph.variables import L0, X0


def ranges(
    keyframe: Ints, measured: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """The distance (R,) m of L(landmark) from X(keyframe)."""
    return [
        gtsam.RangeFactor3D(X0 + k, L0 + j, r, model)
        for k, j, r, model in zip(keyframe.tolist(), landmark.tolist(), measured.tolist(), noise, strict=True)
    ]


def along_ray(
    origins: Floats, directions: Floats, measured: Floats, sigmas: Floats, landmark: Ints
) -> list[gtsam.NonlinearFactor]:
    """The distance (R,) m along a ray (R, 3), (R, 3) in map with known poses, under Huber's loss.

    It says nothing across the ray, hence one row of information.
    """
    points = origins + directions * measured[:, None]
    roots = np.zeros((len(points), 3, 3))
    roots[:, 0] = directions / sigmas[:, None]
    make = gtsam.noiseModel.Gaussian.SqrtInformation
    return [
        gtsam.PriorFactorPoint3(L0 + j, point, huber(make(root)))
        for j, point, root in zip(landmark.tolist(), points, roots, strict=True)
    ]
