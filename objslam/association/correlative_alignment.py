"""Align rays with known landmarks by a planar correction (correlative matching after Olson, ICRA 2009)."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import STRAY_RAY
from objslam.core.types import Rays

_GRID_SIGMAS = 3.0
"""The half width of the grid of corrections, in standard deviations of the drift. A larger value reaches farther."""
_MOST_TURNS, _MOST_SHIFTS = 25, 9  # The most grid steps in yaw and along x or y. A larger value costs time.
_FINE_TURN, _FINE_SHIFT = np.radians(0.4), 0.04  # The finest grid steps (rad, m). Finer corrections are left to association.
_LANDMARK_SIGMA = 0.03
"""The assumed standard deviation (m) of a landmark's position. A larger value accepts rays farther from landmarks."""
_MIN_LEVEL = 0.1
"""The least cosine of a ray's elevation that is used. The heading noise of a ray is its noise divided by this cosine. A
larger value trusts steep rays more."""
_AT_ONCE = 2_000_000  # The most distances computed together. A larger value needs more memory.
_MOST_RANGE_COST = 9.0
"""The most that a range adds to a cost, in squared deviations. Some ranges are wrong. A larger value trusts ranges more."""


def align(
    rays: Rays,
    positions: Floats,
    labels: Ints,
    map_T_camera: Floats,
    centre: Floats,
    spread: Floats,
    share: Floats,
    alike: Floats | None = None,
) -> Floats:
    """Return the planar corrections (K, 4, 4) in map of the camera poses that best align the rays with the landmarks.

    The cost of a ray is its squared deviation from the best landmark of its label, at most `STRAY_RAY`. positions, labels:
    (N, 3) m and (N,) of the landmarks. centre: (3,) m, the point about which a correction turns. spread: (3,) standard
    deviations of the last correction in x, y (m) and yaw (rad). They define its prior and bound the grid. share: (K,) the
    variance of the drift at each pose, as a share of its variance at the last pose. The same share of the last correction is
    expected at the pose. alike: (R, N) the log odds that each ray shows each landmark, from the appearance of its box. None
    if these are not known.
    """
    x, y = (_steps(sigma, _FINE_SHIFT, _MOST_SHIFTS) for sigma in spread[:2])
    shifts, turns = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), _steps(spread[2], _FINE_TURN, _MOST_TURNS)
    scale = np.maximum(spread, 1e-6)
    cost = ((shifts / scale[:2]) ** 2).sum(axis=1)[:, None] + (turns / scale[2]) ** 2
    # A random walk between two known ends is most uncertain in the middle.
    lines = _Lines.of(rays, map_T_camera, centre, share, spread[2] * np.sqrt(share * (1 - share)))
    gain = np.zeros((len(rays), len(positions))) if alike is None else 2 * alike
    ray, landmark = np.nonzero(_reachable(lines, positions - centre, shifts, turns, gain) & (rays.label[:, None] == labels))
    few = max(1, _AT_ONCE // cost.size)  # The number of pairs of a ray and a landmark in a block.
    cuts = np.searchsorted(ray, np.unique(ray))
    ends = np.append(cuts[1:], len(ray))
    while len(cuts):
        block = max(1, int(np.searchsorted(ends - cuts[0], few, side="right")))
        part = slice(cuts[0], ends[block - 1])
        some = lines.take(ray[part])
        misfit = _misfit(some, positions[landmark[part]] - centre, shifts, turns, gain[ray[part], landmark[part]])
        best = np.minimum.reduceat(misfit, cuts[:block] - cuts[0], axis=2)
        cost += (np.minimum(best, STRAY_RAY) - STRAY_RAY).sum(axis=2)
        cuts, ends = cuts[block:], ends[block:]
    shift, turn = np.unravel_index(np.argmin(cost), cost.shape)
    corrections = lift_se2(share[:, None] * np.append(shifts[shift], turns[turn]))
    corrections[:, :3, 3] += centre - corrections[:, :3, :3] @ centre
    return corrections


@dataclass(frozen=True)
class _Lines:
    """R rays, seen from above.

    offset: (R, 2) m, where each ray begins, from the point about which a correction turns. heading, sigma: (R,) rad, the
    direction of the ray and its noise. range, range_sigma: (R,) m, the horizontal part of the range, NaN if unknown, and its
    noise. share: (R,) the share of the correction that the pose of the ray gets.
    """

    offset: Floats
    heading: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    share: Floats

    @classmethod
    def of(cls, rays: Rays, map_T_camera: Floats, centre: Floats, share: Floats, blur: Floats) -> Self:
        """Make lines of rays at camera poses (K, 4, 4) with shares (K,). blur: (K,) rad, the noise of the headings."""
        origin, direction = rays.in_map(map_T_camera)
        level = np.hypot(direction[:, 0], direction[:, 1])
        heading = np.arctan2(direction[:, 1], direction[:, 0])
        sigma = np.hypot(rays.sigma / np.maximum(level, _MIN_LEVEL), blur[rays.keyframe])
        range_sigma = np.hypot(rays.range_sigma, _LANDMARK_SIGMA)
        return cls((origin - centre)[:, :2], heading, sigma, rays.range * level, range_sigma, share[rays.keyframe])

    def take(self, which: Ints) -> Self:
        """Select lines by their indices."""
        return type(self)(*(column[which] for column in vars(self).values()))


def _reachable(lines: _Lines, target: Floats, shifts: Floats, turns: Floats, gain: Floats) -> Bools:
    """Return which rays and landmarks (R, N) may cost less than a stray ray under a shift (S, 2), m, and a turn (T,), rad.

    target: (N, 3) m, the landmarks relative to the centre. gain: (R, N) the amount by which each pair costs less.
    """
    between = target[:, :2] - lines.offset[:, None]
    distance = np.maximum(np.hypot(between[..., 0], between[..., 1]), 1e-6)
    turn = np.abs(turns).max()
    shift = np.hypot(*shifts.T).max() + turn * np.hypot(*lines.offset.T)[:, None]
    nearest = np.maximum(distance - shift, 1e-6)
    spread = np.hypot(lines.sigma[:, None], _LANDMARK_SIGMA / nearest)
    reach = turn + np.arcsin(np.minimum(shift / distance, 1.0)) + spread * np.sqrt(np.maximum(STRAY_RAY + gain, 0.0))
    off = (np.arctan2(between[..., 1], between[..., 0]) - lines.heading[:, None] + np.pi) % (2 * np.pi) - np.pi
    return (np.abs(off) <= reach) | (shift >= distance)


def _misfit(lines: _Lines, target: Floats, shifts: Floats, turns: Floats, gain: Floats) -> Floats:
    """Return the cost (S, T, P) of pairs of a ray and a landmark under each shift (S, 2), m, with each turn (T,), rad.

    target: (P, 3) m, the landmark of each pair, relative to the centre. gain: (P,) the amount by which each pair costs less.
    The sine of the angle between a ray and its landmark replaces the angle, because the sine takes a fifth of the time.
    """
    turned = turns[:, None] * lines.share
    cos, sin = np.cos(turned), np.sin(turned)
    x, y = lines.offset.T
    to_x, to_y = target[:, 0] - (cos * x - sin * y), target[:, 1] - (sin * x + cos * y)
    ray_x, ray_y = np.cos(lines.heading + turned), np.sin(lines.heading + turned)
    dx, dy = (to - shift[:, None, None] * lines.share for to, shift in zip((to_x, to_y), shifts.T, strict=True))
    squared = np.maximum(dx**2 + dy**2, 1e-12)
    deviation = (ray_x * dy - ray_y * dx) ** 2 / (lines.sigma**2 * squared + _LANDMARK_SIGMA**2)
    deviation[ray_x * dx + ray_y * dy <= 0] = np.inf
    if np.isfinite(lines.range).any():
        miss = (np.sqrt(squared) - lines.range) ** 2 / lines.range_sigma**2
        deviation += np.where(np.isfinite(lines.range), np.minimum(miss, _MOST_RANGE_COST), 0.0)
    return np.asarray(deviation - gain)


def _steps(sigma: float, finest: float, most: int) -> Floats:
    """Return the grid values along one axis, 0 among them. finest: the least step. most: the largest number of values."""
    half = int(min(np.ceil(_GRID_SIGMAS * sigma / finest), most // 2))
    return np.linspace(-_GRID_SIGMAS * sigma, _GRID_SIGMAS * sigma, 2 * half + 1) if half else np.zeros(1)
