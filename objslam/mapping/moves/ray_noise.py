"""The noise with which rays miss a thing at rest, at given or at solved poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.types import Keyframes, Rays


@dataclass(frozen=True)
class RayNoise:
    """The standard deviations of R rays. angle: (R,) rad, of the directions. place: m, of the origins, 0 at solved poses."""

    angle: Floats
    place: float

    def at(self, distance: Floats, rays: Ints) -> Floats:
        """Return the standard deviations (n,), rad, of some rays. rays: (n,) indices of rays. distance: (n,) m, to the thing
        of each ray, NaN if unknown."""
        return np.hypot(self.angle[rays], np.nan_to_num(self.place / np.maximum(distance, 1e-9)))


def noise_of_rays(keyframes: Keyframes, rays: Rays, settings: Settings) -> RayNoise:
    """Return the noise of rays. In fixed mode, it includes the noise of the poses, which matters most for near things."""
    from objslam.graph.fixed_pose_triangulation import pose_noise

    return RayNoise(*(pose_noise(rays, keyframes, settings) if settings.mode == "fixed" else (rays.sigma, 0.0)))
