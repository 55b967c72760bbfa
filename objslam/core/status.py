"""Which objects have a position to rely on: the one rule for triangulation, for the map of a run, and for a session's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from objslam import config
from objslam.core.arrays import Floats
from objslam.core.object_map import Status

FEWEST_RAYS = 2
"""The number of rays that fix a point at the least; larger leaves more objects unresolved."""


def is_resolved(sigma: Any, reach: Any, rays: Any, parallax: Any, ranged: Any, limits: config.Triangulation) -> Any:
    """Whether (N,) objects have a position to rely on; arrays, tensors, or numbers for one object.

    sigma: (N,) m, the largest standard deviation of the position as seen from a camera that saw it, without the drift of the
    map up to there; inf or NaN where it is not determined. reach: (N,) m, as `reach` has it. rays: (N,) number of those that
    agree. parallax: (N,) rad, the widest angle between them. ranged: (N,) whether ranges say what parallax would.
    """
    wide = ranged | (parallax >= math.radians(limits.min_parallax_deg))
    return wide & (rays >= FEWEST_RAYS) & (sigma <= limits.max_rel_sigma * reach)


def status_of(sigma: float, reach: float, rays: int, parallax: float, ranged: bool, limits: config.Triangulation) -> Status:
    """What `is_resolved` makes of one object."""
    return "ok" if bool(is_resolved(sigma, reach, rays, parallax, ranged, limits)) else "unresolved"


def reach(position: Floats, origins: Floats) -> float:
    """The median distance, m, of a position (3,) from where its rays (R, 3) begin; NaN without any."""
    return float(np.median(np.linalg.norm(position - origins, axis=1))) if len(origins) else math.nan
