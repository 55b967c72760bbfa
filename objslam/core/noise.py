"""The noise of a log's measurements, as factors on the noise in the settings."""

from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from typing import NamedTuple

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.statistics import Lasting
from objslam.core.types import Rays


class LabelNoise(NamedTuple):
    """The noise of the ranges of one label, as factors on `depth.sigma` and on `depth.bias`."""

    label: str
    ranges: float
    range_bias: float


@dataclass(frozen=True)
class NoiseFactors:
    """Factors on the standard deviations of the settings, and the shrinkage that this noise causes.

    The first eight fields are factors on these settings. rays: `rays.pixel_sigma` and `rays.box_sigma`. ranges:
    `depth.sigma` and `depth.sigma_per_m`. range_bias: `depth.bias`. along: `odometry.x_per_m` and `odometry.xy_per_rad`.
    across: `odometry.y_per_m` and `odometry.floor_xy`. turning: the odometry's noise of the heading. heading:
    `localization.yaw`. place: `localization.xy`. shrinkage: the share by which a joint solve makes all lengths too short.
    Four fields describe lasting errors (`Lasting`) of localised headings and places. heading_share, place_share: the share
    of the variance that lasts. heading_seconds, place_seconds: how long the lasting part lasts, s. by_label: the noise of
    the ranges of some labels. It replaces `ranges` and `range_bias` for these labels.
    """

    rays: float = 1.0
    ranges: float = 1.0
    range_bias: float = 1.0
    along: float = 1.0
    across: float = 1.0
    turning: float = 1.0
    heading: float = 1.0
    place: float = 1.0
    shrinkage: float = 0.0
    heading_share: float = 0.0
    heading_seconds: float = 0.0
    place_share: float = 0.0
    place_seconds: float = 0.0
    by_label: tuple[LabelNoise, ...] = ()

    @property
    def lasting(self) -> tuple[Lasting, Lasting]:
        """The lasting parts of the errors of localised headings and places."""
        return Lasting(self.heading_share, self.heading_seconds), Lasting(self.place_share, self.place_seconds)

    @property
    def factors(self) -> Floats:
        """(8,) all factors on standard deviations."""
        return np.array([getattr(self, name) for name in FACTORS])

    def settings(self, nominal: Settings) -> Settings:
        """Return the settings with the odometry noise multiplied by the factors. `rays_with_noise` multiplies the noise of
        rays and ranges."""
        if self.along == self.across == self.turning == 1:
            return nominal
        of = nominal.odometry
        odometry = {
            "x_per_m": of.x_per_m * self.along,
            "xy_per_rad": of.xy_per_rad * self.along,
            "y_per_m": of.y_per_m * self.across,
            "floor_xy": of.floor_xy * self.across,
            "yaw_per_m": of.yaw_per_m * self.turning,
            "yaw_per_rad": of.yaw_per_rad * self.turning,
            "floor_yaw": of.floor_yaw * self.turning,
        }
        return nominal.model_copy(update={"odometry": of.model_copy(update=odometry)})

    @property
    def lasting_factors(self) -> tuple[float, float]:
        """The factors on `localization.yaw` and `localization.xy` of the errors that last for seconds."""
        (turned, moved) = self.lasting
        return self.heading * turned.share**0.5, self.place * moved.share**0.5

    def rays_with_noise(self, nominal: Rays) -> Rays:
        """Return rays whose noise of directions and ranges is multiplied by the factors."""
        if self.rays == self.ranges == self.range_bias == 1 and not self.by_label:
            return nominal
        ranges, range_bias = self.of_labels(nominal.label_names)[:, nominal.label]
        return replace(
            nominal,
            sigma=nominal.sigma * self.rays,
            range_sigma=nominal.range_sigma * ranges,
            range_bias=nominal.range_bias * range_bias,
        )

    def of_labels(self, names: Sequence[str]) -> Floats:
        """Return the factors (2, L) on the noise of single ranges and on their bias, for labels with these names (L,)."""
        told = {label: (ranges, bias) for label, ranges, bias in self.by_label}
        factors = [told.get(name, (self.ranges, self.range_bias)) for name in names]
        return np.array(factors, dtype=np.float64).reshape(-1, 2).T

    def like(self, other: "NoiseFactors", tolerance: float) -> bool:
        """Return whether all factors agree with the factors of `other` within a relative tolerance, and whether the lasting
        errors agree (`Lasting.like`). The shrinkage is not compared."""
        mine, its = self.factors, other.factors
        lasting = all(one.like(two, tolerance) for one, two in zip(self.lasting, other.lasting, strict=True))
        names = [one.label for one in (*self.by_label, *other.by_label)]
        mine, its = (np.append(factors, of.of_labels(names)) for factors, of in ((mine, self), (its, other)))
        return lasting and bool((np.abs(np.log(np.maximum(mine, 1e-9) / np.maximum(its, 1e-9))) < tolerance).all())

    def to_dict(self, digits: int | None = 4) -> dict[str, float]:
        """Return the factors and the shrinkage by name, as in summary.json. If `digits` is not None, they are rounded to
        that many decimals."""
        factors = {name: value for name, value in asdict(self).items() if name != "by_label"}
        return {name: value if digits is None else round(value, digits) for name, value in factors.items()}

    def labels_to_dict(self) -> dict[str, dict[str, float]]:
        """Return the factors on the noise of ranges and on their bias, by label, as in summary.json."""
        return {one.label: {"ranges": round(one.ranges, 4), "range_bias": round(one.range_bias, 4)} for one in self.by_label}


FACTORS = ("rays", "ranges", "range_bias", "along", "across", "turning", "heading", "place")
"""The fields of `NoiseFactors` that are factors on standard deviations."""

MOST_NOISE = 20.0
"""The largest estimated factor on a noise. With a larger factor, wrong units or axes of measurements are taken for noise.
Real robots have factors up to 6.3. The largest factor is of odometry that is only the commanded speed."""

MOST_POSE_NOISE = 300.0
"""The largest estimated factor on `localization.xy` and `localization.yaw`. With the default settings, it allows errors of 6
m, such as those of a GPS between houses, and any error of the heading. With a larger factor, wrong units of a path are taken
for noise."""

NOMINAL = NoiseFactors()
"""The noise in the settings, unchanged."""


def range_noise(
    ranges: Floats, half: Floats, camera: Ints, cameras: Sequence[Camera], settings: Settings
) -> tuple[Floats, Floats]:
    """Return the standard deviations (n,), m, of ranges (n,), m, and of the bias that all ranges of an object share.

    half: (n,) half the width of each thing, in m per m of the thing's distance (`surface_ranges.half_widths`). camera: (n,)
    the index of each range's camera. A camera without `depth_noise` has the noise in the settings.
    """
    of = settings.depth
    told = [(of.sigma, of.sigma_per_m, of.bias) if c.depth_noise is None else astuple(c.depth_noise) for c in cameras]
    sigma, per_m, bias = np.array(told, dtype=np.float64).reshape(-1, 3)[camera].T
    # The distance of the centre behind the surface differs between logs, and between the things of a log.
    share = np.hypot(of.centre_sigma, settings.calibration.surface)
    return sigma + per_m * ranges, np.hypot(bias, share * half * ranges)
