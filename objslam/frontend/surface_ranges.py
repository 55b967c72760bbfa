"""Ranges that end on the visible surface of a thing, and the distance of its centre behind the surface."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera, box_sizes
from objslam.core.types import Keyframes, Rays

_LEAST = 0.2
"""The least ratio of the range of a surface to the distance of the centre behind it. With a smaller ratio, boxes that fill
the image move centres farther away. It is also the least ratio of a range to the range before the correction of an
offset."""


def half_widths(
    box: Floats, direction: Floats, cameras: Sequence[Camera], camera: Ints, flat: np.ndarray | bool = False
) -> Floats:
    """Return half the width (R,) of the thing in each box, in m per m of the thing's distance.

    The result is 0 for cameras whose boxes do not show sizes, and for things that are known to be flat. box: (R, 4) px.
    direction: (R, 3) unit, in the camera frame. camera: (R,) the index of each box's camera in `cameras`. flat: (R,) whether
    a thing is a fiducial.
    """
    sized = np.array([c.sees_size for c in cameras], dtype=bool)[camera]
    return np.where(sized & ~np.asarray(flat), box_sizes(box, direction, cameras, camera)[:, 0] / 2, 0.0)


def half_widths_of_rays(rays: Rays, keyframes: Keyframes, cameras: Sequence[Camera]) -> Floats:
    """Return half the width (R,) of the thing in the box of each ray, as `half_widths`."""
    flat = False if rays.corner_sigma is None else np.isfinite(rays.corner_sigma)
    return half_widths(rays.box, rays.direction, cameras, keyframes.camera[rays.keyframe], flat)


def to_centres(half: Floats, share: Floats | float) -> Floats:
    """Return the ratio (R,) of the distance of the centre of a thing to the range of its surface.

    half: (R,) from `half_widths`. share: how far the centre is behind the surface, as a share of half the width.
    """
    return np.asarray(1 / np.maximum(1 - share * half, _LEAST))


def range_factors(errors: Mapping[str, float], half: Floats) -> Floats:
    """Return the factors (R,) that correct ranges for the shared errors `range_scale` and `surface`. half: as
    `half_widths`."""
    return (1 + errors.get("range_scale", 0.0)) * to_centres(half, errors.get("surface", 0.0))


def corrected_ranges(errors: Mapping[str, float], ranges: Floats, direction: Floats, factors: Floats) -> Floats:
    """Return ranges (R,), m, corrected for the shared errors.

    direction: (R, 3) unit, in the camera frame. The offset is along the optical axis. factors: as `range_factors`.
    """
    offset = errors.get("range_offset", 0.0)
    return np.maximum(ranges * factors + offset / direction[:, 2], _LEAST * ranges) if offset else ranges * factors


def corrected_lengths(errors: Mapping[str, float], rays: Rays, half: Floats, larger: float) -> tuple[Floats, Floats, Floats]:
    """Return the ranges (R,), m, of rays, their standard deviations (R,) and those of their `range_bias` (R,), m, corrected
    for the shared errors.

    Both standard deviations grow with the ranges. Otherwise a smaller map would fit better.

    half: as `half_widths`. larger: an additional factor on the ranges and on both standard deviations, by which the map is
    enlarged.
    """
    factors = range_factors(errors, half) * larger
    ranges = corrected_ranges(errors, rays.range, rays.direction, factors)
    return ranges, rays.range_sigma * factors, rays.range_bias * factors


def measured_ranges(errors: Mapping[str, float], ranges: Floats, direction: Floats, factors: Floats) -> Floats:
    """Return the ranges (R,), m, that `corrected_ranges` turned into `ranges`. Ranges that it limited are not restored."""
    offset = errors.get("range_offset", 0.0)
    return (ranges - offset / direction[:, 2]) / factors if offset else ranges / factors


def centre_factors(rays: Rays, errors: Mapping[str, float], half: Floats, settings: Settings) -> Floats:
    """Return the ratios (R,) of corrected ranges of centres to corrected ranges of surfaces. half: (R,) as `half_widths`."""
    common = to_centres(half * weights_of(rays), errors.get("surface", 0.0))
    return to_centres(half, shares_of(rays, settings)) * common


def shares_of(rays: Rays, settings: Settings) -> Floats | float:
    """Return by how much (R,) ranges were lengthened from surfaces to centres, as shares of half the width."""
    return settings.depth.centre if rays.surface is None else rays.surface[:, 0]


def weights_of(rays: Rays) -> Floats | float:
    """Return the weights (R,) with which the shared error `surface` is added to the shares of `shares_of`."""
    return 1.0 if rays.surface is None else rays.surface[:, 1]


def with_known_surfaces(rays: Rays, half: Floats, sigma: float) -> Rays:
    """Return the rays without the error `surface` in their `range_bias`. The solve estimates `surface`, which all things of
    a log share.

    half: (R,) as `half_widths`. sigma: the standard deviation of `surface` that `Rays.range_bias` contains.
    """
    shared = sigma * half * rays.range
    return replace(rays, range_bias=np.sqrt(np.maximum(rays.range_bias**2 - np.nan_to_num(shared) ** 2, 0.0)))
