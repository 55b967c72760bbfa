"""How far the centres of bodies are behind the surfaces on which ranges end. The widths of boxes give one share for all
things. A body that was seen from many sides gives its own share."""

from __future__ import annotations

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.noise import range_noise
from objslam.core.statistics import grouped_median
from objslam.frontend.surface_ranges import half_widths_of_rays, shares_of, to_centres
from objslam.mapping.bodies.box_views import BoxViews
from objslam.mapping.solution import RangeShift
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.shapes import rows_of_kinds
from objslam.triangulation.bodies.solve import Bodies

_UNLIKE = 0.3
"""The standard deviation of the difference between the surfaces of a thing and of its body, as a share of half the width.
The surfaces of rendered rings, buttons and stands with open fronts were 0.3 behind the surfaces of their bodies, with a
spread of 0.3. For simulated boxes, cylinders and balls, the two surfaces agreed to 0.07. A larger number trusts bodies
less."""
_UNSEEN = 0.5
"""The standard deviation of the distance from the surface to the centre of a body that was seen from one side only. It is a
share of half the width. Such a body has only its prior. In simulated drives past things, the standard deviation was 0.4 to
0.6. With a larger number, bodies that were seen from few sides count more."""
_OF_SURFACES = 0.4
"""The least share of the distance to the surface from which ranges count as ending on surfaces. Ranges may end at the centre
of a body (share 0) or on its surface (share 1). A solve without bodies estimates this share. In simulated drives, the share
was 0.47 to 1.0 with depths of surfaces, and 0 to 0.31 with depths of centres. If a log does not show the share, it is about
`depth.centre`. With a larger value, bodies correct the ranges of fewer logs."""


def range_shift(found: Bodies, views: BoxViews, ray: Ints, count: int, settings: Settings, common: float) -> RangeShift:
    """Return the corrections of `count` rays that make their ranges end at the centres of bodies.

    Two sources tell how far the centre is behind the surface: the body, and the width of the box. They are weighted by their
    variances, and all rays of an object have the same weights. If `depth.centre` is 0, ranges already end at centres.

    ray: (B,) the ray of each box. common: the standard deviation of the share that is common to all things of a log. It is 0
    if the run estimates this share.
    """
    shift, edges, rays = RangeShift.none(count), views.edges(), views.rays
    half = half_widths_of_rays(rays, views.keyframes, views.cameras)
    behind, sigma = _behind_surfaces(found, edges)
    wide = half * np.linalg.norm(found.axes[edges.body, :3] - edges.origin, axis=1)  # m
    told = np.isfinite(behind) & np.isfinite(rays.range) & (wide > 0)
    if not settings.depth.centre or not told.any() or not _end_on_surfaces(found, edges, behind, told):
        return shift
    number = len(found.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = grouped_median((behind / wide)[told], edges.body[told], number)
        own = grouped_median((sigma / wide)[told], edges.body[told], number)
        seen = np.maximum(own**-2 - _UNSEEN**-2, 0.0)  # What the boxes tell beyond the prior of a body.
        variance, prior = 1 / seen + _UNLIKE**2, settings.depth.centre_sigma**2 + common**2
    weight = 1 / (1 + prior / variance)  # The weight of the share that all things have in common.
    use = np.isfinite(weight)[edges.body] & (wide > 0) & np.isfinite(rays.range)
    weight, before = weight[edges.body], shares_of(rays, settings)
    # The centre of a thing is as far behind its surface as the centre of its body in this direction, where known.
    of_body = np.where(told, behind / np.maximum(wide, 1e-9), share[edges.body])
    after = weight * settings.depth.centre + (1 - weight) * of_body
    factor = to_centres(half, after) / to_centres(half, before)
    # The rays may have the noise of a solve. The share of the width in their bias is that of the settings.
    _, bias = range_noise(rays.range, half, views.camera, views.cameras, settings)
    beside = bias**2 - (settings.depth.centre_sigma**2 + settings.calibration.surface**2) * (half * rays.range) ** 2
    of_width = prior * (half * rays.range) ** 2
    beside = np.maximum(beside, 0.0)
    less = np.sqrt((beside + weight * of_width) / np.maximum(beside + of_width, 1e-12))
    at = ray[use]
    shift.factor[at], shift.bias[at] = factor[use], less[use]
    shift.surface[at] = np.column_stack([after, weight])[use]
    return shift


def _behind_surfaces(found: Bodies, edges: BoxEdges) -> tuple[Floats, Floats]:
    """Return the distance (B,), m, of each body's centre behind its surface, and the standard deviation (B,), m.

    The surface is taken on the ray through the box. Both values are NaN for a ray that misses its body, and for a point.
    """
    behind, sigma = np.full(len(edges), np.nan), np.full(len(edges), np.nan)
    for kind, rows in rows_of_kinds(found.shape[edges.body]):
        some = edges.take(rows)
        own, away = found.values[some.body], found.values[some.body, :3] - some.origin
        distance = np.linalg.norm(away, axis=1)
        reach, by, hit = kind.ranges(own, some.origin, some.direction)
        slope = -by
        slope[:, :3] += away / np.maximum(distance, 1e-9)[:, None]
        between = np.einsum("bii->b", found.between_shapes[some.body, 3:5, 3:5]) / 2
        variance = np.einsum("bi,bij,bj->b", slope, found.covariance[some.body], slope) + between
        hit = hit & (found.shape[some.body] > 0)
        behind[rows] = np.where(hit, distance - reach, np.nan)
        sigma[rows] = np.where(hit, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    return behind, sigma


def _end_on_surfaces(found: Bodies, edges: BoxEdges, behind: Floats, told: Bools) -> bool:
    """Return whether ranges seem to end on the surfaces of bodies, and not at their centres (`_OF_SURFACES`)."""
    away = np.linalg.norm(found.axes[edges.body, :3] - edges.origin, axis=1) - edges.range
    number = len(found.shape)
    measured, of_body = (grouped_median(part[told], edges.body[told], number) for part in (away, behind))
    some = np.isfinite(of_body) & np.isfinite(measured)
    return bool((measured[some] * of_body[some]).sum() > _OF_SURFACES * (of_body[some] ** 2).sum())
