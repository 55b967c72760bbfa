"""The factors of rays, offline and live: each has a bearing, and a range where one came with it."""

from __future__ import annotations

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
    """Rays of a live session, as its graph takes them.

    number: (n,) their own. keyframe, landmark: (n,). direction: (n, 3) in the camera. sigma: (n,) rad. range: (n,) m along
    the ray, NaN where unknown; range_sigma: (n,) m.
    """

    number: Ints
    keyframe: Ints
    landmark: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats


def ray_factors(
    rays: Rays | Bearings, landmark: Ints, loss: Loss, settings: Settings
) -> list[tuple[Ints, list[gtsam.NonlinearFactor]]]:
    """The factors of rays by their kind: which rays (m,) have one, and the factors in their order.

    Args:
        landmark: (n,) the landmark of each ray.
        loss: that of the bearings; ranges have Cauchy's.
    Returns:
        First the bearings, which all rays have, or the point-to-line distances where joint.factor says so; then the ranges.
    """
    if settings.joint.factor == "bearing":
        made = bearings(rays.keyframe, rays.direction, landmark, robust(loss, rays.sigma, 2, L1_RADIANS))
    else:
        noise = robust(loss, np.full(len(landmark), EQ1_SIGMA), 2)
        made = point_to_line(rays.keyframe, rays.direction, landmark, noise)
    ranged = np.flatnonzero(np.isfinite(rays.range))
    noise = robust("cauchy", rays.range_sigma[ranged], 1)
    return [
        (np.arange(len(landmark)), made),
        (ranged, ranges(rays.keyframe[ranged], rays.range[ranged], landmark[ranged], noise)),
    ]
