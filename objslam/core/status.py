"""The rule by which an object counts as resolved. Triangulation, runs and sessions share it."""

import math
from typing import Any

import numpy as np

from objslam import config
from objslam.core.arrays import Floats
from objslam.core.object_map import Status

FEWEST_RAYS = 2
"""The least number of rays that fix a point. A larger number leaves more objects unresolved."""


def is_resolved(sigma: Any, reach: Any, rays: Any, parallax: Any, ranged: Any, limits: config.Triangulation) -> Any:
    """Return whether the position of each object (N,) is reliable. Arguments are arrays, tensors, or scalars for one object.

    sigma: (N,) m, `Estimate.seen_sigma`, or inf or NaN if the rays do not determine the position. reach: (N,) m, from the
    function `reach`. rays: (N,) number of inlier rays. parallax: (N,) rad, the widest angle between them. ranged: (N,)
    whether measured ranges replace the parallax. limits: the settings of the triangulation.
    """
    wide = ranged | (parallax >= math.radians(limits.min_parallax_deg))
    return wide & (rays >= FEWEST_RAYS) & (sigma <= limits.max_rel_sigma * reach)


def status_of(sigma: float, reach: float, rays: int, parallax: float, ranged: bool, limits: config.Triangulation) -> Status:
    """Return the status of one object by `is_resolved`."""
    return "ok" if is_resolved(sigma, reach, rays, parallax, ranged, limits) else "unresolved"


def reach(position: Floats, origins: Floats) -> float:
    """Return the median distance, m, of a position (3,) from the origins (R, 3) of its rays. Without rays it is NaN."""
    return float(np.median(np.linalg.norm(position - origins, axis=1))) if len(origins) else math.nan
