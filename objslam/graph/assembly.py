"""The graph of a log: the one place that says which factors its measurements become.

Both initialisations, outlier rejection and the final solve take their factors from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import is_planar
from objslam.core.types import Keyframes, Rays
from objslam.graph.factors.bearing import point_to_line_fixed
from objslam.graph.factors.localization import localizations
from objslam.graph.factors.noise import robust
from objslam.graph.factors.odometry import betweens, motions
from objslam.graph.factors.priors import anchor, landmark_priors
from objslam.graph.factors.range import along_ray
from objslam.graph.factors.rays import ray_factors


@dataclass(frozen=True)
class Measurements:
    """What a log measured. motion: (K-1, 4, 4), covariance: (K-1, 6, 6) the cameras' by odometry, None without it."""

    keyframes: Keyframes
    rays: Rays
    settings: Settings
    motion: Floats | None
    covariance: Floats | None

    @classmethod
    def of(cls, keyframes: Keyframes, rays: Rays, settings: Settings) -> Self:
        """The measurements of some keyframes and their rays."""
        moved = (None, None) if keyframes.odom_T_base is None else motions(keyframes, settings)
        return cls(keyframes, rays, settings, *moved)

    def odometry(self) -> tuple[Floats, Floats]:
        """Motions (K-1, 4, 4) and their covariances (K-1, 6, 6); ValueError without odometry."""
        if self.motion is None or self.covariance is None:
            raise ValueError("motions need odometry")
        return self.motion, self.covariance

    def factors(
        self,
        owner: Ints,
        which: Ints,
        landmarks: Ints,
        positions: Floats,
        loss: Loss = "huber",
        begin: int = 0,
        end: int | None = None,
    ) -> list[gtsam.NonlinearFactor]:
        """What a graph gains with keyframes begin to end, some rays and some landmarks; by default with all keyframes.

        Args:
            owner: (R,) the landmark of each ray, -1 without.
            which: (n,) the rays that come in; the first n factors are their bearings, in their order.
            landmarks: (m,) those that come in.
            positions: (N, 3) m in map, where landmarks are.
            loss: that of the bearings.
        """
        keyframes, settings = self.keyframes, self.settings
        end = len(keyframes) if end is None else end
        made = [f for _, group in ray_factors(self.rays.take(which), owner[which], loss, settings) for f in group]
        made += landmark_priors(landmarks, positions, settings)
        if self.motion is not None and self.covariance is not None:
            steps = slice(max(begin - 1, 0), end - 1)
            made += betweens(self.motion[steps], self.covariance[steps], steps.start, keyframes.measured[steps])
        if keyframes.localized_every:
            on_plane = is_planar(keyframes.map_T_base)
            made += localizations(keyframes.take(np.arange(begin, end)), settings, begin, on_plane)
        elif begin == 0:
            made.append(anchor(0, keyframes.map_T_camera[0]))
        return made


def fixed_pose_factors(
    rays: Rays, origins: Floats, directions: Floats, landmark: Ints, across: Floats, loss: Loss
) -> list[gtsam.NonlinearFactor]:
    """The factors of rays at known poses: first each one's distance from its landmark, then the ranges, but not for `l1`.

    Args:
        origins, directions: (n, 3), (n, 3) of the rays in map.
        landmark: (n,) that of each ray.
        across: (n,) m, the rays' noise across at their landmarks; Eq. 1, which is the loss `l1`, knows none.
    """
    made = point_to_line_fixed(
        origins, directions, landmark, robust(loss, np.ones(len(rays)) if loss == "l1" else across, 2)
    )
    at = np.flatnonzero(np.isfinite(rays.range) & (loss != "l1"))
    return made + along_ray(origins[at], directions[at], rays.range[at], rays.range_sigma[at], landmark[at])
