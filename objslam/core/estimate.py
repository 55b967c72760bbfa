"""What a solve found: poses, objects, weights and costs."""

from __future__ import annotations

from dataclasses import dataclass

from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import Calibration


@dataclass(frozen=True)
class Estimate:
    """What a solve found.

    map_T_base: (K, 4, 4). positions: (N, 3) m. covariance: (N, 3, 3) m^2, NaN where not solved. solved: (N,) whether the
    object was part of the graph. seen_sigma: (N,) m, the largest standard deviation of its place as seen from a camera that
    saw it: the map's own drift up to there is not in it. NaN where not solved. weight: (R,) each ray's robust weight in
    [0, 1], 0 without object or when rejected. The costs are the graph's error at the first start and at the last optimum;
    for Eq. 1 its sum of distances, m. calibration: the shared errors that were estimated, None if none were. The keyframes and
    rays that belong to the estimate have them taken out.
    """

    map_T_base: Floats
    positions: Floats
    covariance: Floats
    seen_sigma: Floats
    solved: Bools
    weight: Floats
    cost_before: float
    cost_after: float
    iterations: int
    calibration: Calibration | None = None
