"""The noise of a log's measurements, as factors on the noise in the settings."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.types import Rays


@dataclass(frozen=True)
class NoiseFactors:
    """Factors on the standard deviations of the settings, and the shrinkage that this noise causes.

    rays: `rays.pixel_sigma` and `rays.box_sigma`. ranges: `depth.sigma` and `depth.sigma_per_m`. range_bias: `depth.bias`.
    along: `odometry.x_per_m` and `odometry.xy_per_rad`. across: `odometry.y_per_m` and `odometry.floor_xy`. turning: the
    odometry's noise of the heading. shrinkage: the share by which a joint solve makes all lengths too short (0: by nothing).
    """

    rays: float = 1.0
    ranges: float = 1.0
    range_bias: float = 1.0
    along: float = 1.0
    across: float = 1.0
    turning: float = 1.0
    shrinkage: float = 0.0

    def settings(self, nominal: Settings) -> Settings:
        """Return the settings with the noise of odometry and ranges multiplied. `rays_with_noise` has that of rays."""
        of, depth = nominal.odometry, nominal.depth
        odometry = {
            "x_per_m": of.x_per_m * self.along,
            "xy_per_rad": of.xy_per_rad * self.along,
            "y_per_m": of.y_per_m * self.across,
            "floor_xy": of.floor_xy * self.across,
            "yaw_per_m": of.yaw_per_m * self.turning,
            "yaw_per_rad": of.yaw_per_rad * self.turning,
            "floor_yaw": of.floor_yaw * self.turning,
        }
        ranges = {
            "sigma": depth.sigma * self.ranges,
            "sigma_per_m": depth.sigma_per_m * self.ranges,
            "bias": depth.bias * self.range_bias,
        }
        return nominal.model_copy(
            update={"odometry": of.model_copy(update=odometry), "depth": depth.model_copy(update=ranges)}
        )

    def rays_with_noise(self, nominal: Rays) -> Rays:
        """Return rays with their noise multiplied."""
        return replace(nominal, sigma=nominal.sigma * self.rays, range_sigma=nominal.range_sigma * self.ranges)

    def like(self, other: "NoiseFactors", tolerance: float) -> bool:
        """Return whether all factors agree with those of another within a relative tolerance."""
        mine, its = (np.array(list(one.to_dict(None).values())) for one in (self, other))
        return bool((np.abs(np.log(np.maximum(mine[:-1], 1e-9) / np.maximum(its[:-1], 1e-9))) < tolerance).all())

    def to_dict(self, digits: int | None = 4) -> dict[str, float]:
        """Return the factors by name, rounded to `digits` decimals, as summary.json holds them."""
        return {name: value if digits is None else round(value, digits) for name, value in asdict(self).items()}


NOMINAL = NoiseFactors()
"""The noise in the settings, unchanged."""
