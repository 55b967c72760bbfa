"""Make the factors of rays, offline and live: a bearing for each ray, and a range for each ray with a measured range."""

from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.types import Rays
from objslam.graph.factors.bearing import EQ1_SIGMA, L1_RADIANS, bearings, point_to_line
from objslam.graph.factors.noise import robust
from objslam.graph.factors.range import ranges


@dataclass(frozen=True)
class Bearings:
    """Rays that a live session adds to its graph.

    number: (n,) the number of each ray. keyframe: (n,) the k of X(k). landmark: (n,) the j of L(j). direction: (n, 3) in the
    camera frame. sigma: (n,) rad. range: (n,) m along the ray, NaN where unknown. range_sigma: (n,) m. offset: (n, 3) m, the
    origins of the rays in the camera frame, None if all begin at the camera.
    """

    number: Ints
    keyframe: Ints
    landmark: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    offset: Floats | None = None


def ray_factors(
    rays: Rays | Bearings, landmark: Ints, loss: Loss, settings: Settings
) -> list[tuple[Ints, list[gtsam.NonlinearFactor]]]:
    """Return two groups of factors. Each group has the indices (m,) of its rays, and one factor for each index.

    The first group has the bearings of all rays, or their distances of Eq. 1 if joint.factor is `point_to_line`. The second
    group has the ranges of the rays with a measured range.

    landmark: (n,) the landmark of each ray. loss: the loss of the first group. Ranges have Cauchy's loss.
    """
    if settings.joint.factor == "bearing":
        noise = robust(loss, rays.sigma, 2, L1_RADIANS)
        made = bearings(rays.keyframe, rays.direction, landmark, noise, rays.offset)
    else:
        noise = robust(loss, np.full(len(landmark), EQ1_SIGMA), 2)
        made = point_to_line(rays.keyframe, rays.direction, landmark, noise, rays.offset)
    ranged = np.flatnonzero(np.isfinite(rays.range))
    noise = robust("cauchy", rays.range_sigma[ranged], 1)
    at = None if rays.offset is None else rays.offset[ranged]
    return [
        (np.arange(len(landmark)), made),
        (ranged, ranges(rays.keyframe[ranged], rays.range[ranged], landmark[ranged], noise, at)),
    ]
