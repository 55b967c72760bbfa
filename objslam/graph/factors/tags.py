"""Factors that tie the four corners of a square fiducial to its pose. The corners are landmarks, seen by bearings."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.graph.variables import L0, TAG0, TAG_SIZE0

TIE = 1e-3
"""The standard deviation of the tie between a corner and the pose of its tag, as a share of their distance. A larger share
lets a square bend. A smaller share conditions the linear system worse. Printed tags have about this error. The noise of
detected corners is at least a hundred times larger."""


def tag_ties(
    tags: Ints, landmarks: Ints, shapes: Floats, sides: Floats, first_sides: Floats, prior_sigma: float
) -> list[gtsam.NonlinearFactor]:
    """Return the factors that make four landmarks the corners of one square, for each of the tags.

    In the frame of the tag, each corner is in a known direction, at half the diagonal. If the side is not known, half the
    diagonal is a variable too: Z(t) (m) is its first value minus its present value.

    Args:
        tags: (n,) the numbers of the tags.
        landmarks: (n, 4) the landmark of each corner.
        shapes: (n, 4, 3) the corners of a tag of side 1 in its frame.
        sides: (n,) m, NaN if unknown. first_sides: (n,) m, the first value of an unknown side.
        prior_sigma: m, the standard deviation of half the diagonal of a tag with an unknown side.
    """
    made: list[gtsam.NonlinearFactor] = []
    level, one = gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma
    columns = (tags.tolist(), landmarks.tolist(), shapes, sides.tolist(), first_sides.tolist())
    for t, corners, shape, side, first in zip(*columns, strict=True):
        known = np.isfinite(side)
        reach = float(np.linalg.norm(shape[0])) * (side if known else first)
        along = one(1, TIE * reach)
        both = gtsam.noiseModel.Diagonal.Sigmas(np.array([TIE, TIE, TIE * reach]))
        for j, at in zip(corners, shape, strict=True):
            towards = gtsam.Unit3(at)
            if known:
                made.append(gtsam.BearingRangeFactor3D(TAG0 + t, L0 + j, towards, reach, both))
                continue
            made.append(gtsam.BearingFactor3D(TAG0 + t, L0 + j, towards, one(2, TIE)))
            made.append(gtsam.RangeFactorWithTransformBias3D(TAG0 + t, L0 + j, TAG_SIZE0 + t, reach, along, level))
        if not known:
            made.append(gtsam.PriorFactorDouble(TAG_SIZE0 + t, 0.0, one(1, prior_sigma)))
    return made
