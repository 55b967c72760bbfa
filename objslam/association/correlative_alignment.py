"""Align rays with known landmarks by a planar correction (correlative matching after Olson, ICRA 2009)."""

import numpy as np

from objslam.core.arrays import Floats, Ints
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
"""The least cosine of an elevation. A ray's heading noise is its noise divided by this cosine. A larger value trusts steep
rays more."""
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
    alike: Floats | None = None,
) -> Floats:
    """Return the planar correction (4, 4) in map of the camera poses that best aligns the rays with the landmarks.

    The cost of a ray is its squared deviation from the best landmark of its label, at most `STRAY_RAY`. positions, labels:
    (N, 3) m and (N,) of the landmarks. centre: (3,) m, the point about which the correction turns. spread: (3,) standard
    deviations of the correction in x, y (m) and yaw (rad). They define its prior and bound the grid. alike: (R, N) the log
    odds that each ray shows each landmark, from its appearance. None if this is not known.
    """
    if alike is None:
        alike = np.zeros((len(rays), len(positions)))
    steps = (_steps(spread[0], _FINE_SHIFT, _MOST_SHIFTS), _steps(spread[1], _FINE_SHIFT, _MOST_SHIFTS))
    grid = np.stack(np.meshgrid(*steps, _steps(spread[2], _FINE_TURN, _MOST_TURNS), indexing="ij"), axis=-1).reshape(-1, 3)
    cost = ((grid / np.maximum(spread, 1e-6)) ** 2).sum(axis=1)
    few = max(1, _AT_ONCE // max(1, len(positions)))  # The number of rays in a block.
    size = max(1, _AT_ONCE // max(1, min(len(rays), few) * len(positions)))
    for first in range(0, len(rays), few):
        some = rays.take(np.arange(first, min(first + few, len(rays))))
        for begin in range(0, len(grid), size):
            part = slice(begin, begin + size)
            gain = 2 * alike[first : first + few]
            cost[part] += _misfit(some, positions, labels, map_T_camera, centre, grid[part], gain)
    correction = lift_se2(grid[np.argmin(cost)])
    correction[:3, 3] += centre - correction[:3, :3] @ centre
    return correction


def _misfit(
    rays: Rays,
    positions: Floats,
    labels: Ints,
    map_T_camera: Floats,
    centre: Floats,
    corrections: Floats,
    gain: Floats,
) -> Floats:
    """Return the cost (H,) of all rays together under each of the corrections (H, 3). gain: (R, N) lowers the cost of each
    ray at each landmark."""
    origin, direction = rays.in_map(map_T_camera)
    offset, level = origin - centre, np.hypot(direction[:, 0], direction[:, 1])
    cos, sin = np.cos(corrections[:, 2, None]), np.sin(corrections[:, 2, None])
    x = centre[0] + corrections[:, :1] + cos * offset[:, 0] - sin * offset[:, 1]
    y = centre[1] + corrections[:, 1:2] + sin * offset[:, 0] + cos * offset[:, 1]
    heading = np.arctan2(direction[:, 1], direction[:, 0]) + corrections[:, 2, None]
    dx, dy = positions[:, 0] - x[..., None], positions[:, 1] - y[..., None]  # (H, R, N)
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    angle = (np.arctan2(dy, dx) - heading[..., None] + np.pi) % (2 * np.pi) - np.pi
    sigma = (rays.sigma / np.maximum(level, _MIN_LEVEL))[:, None]
    deviation = angle**2 / (sigma**2 + (_LANDMARK_SIGMA / distance) ** 2)
    miss = (distance - (rays.range * level)[:, None]) ** 2 / (rays.range_sigma**2 + _LANDMARK_SIGMA**2)[:, None]
    deviation += np.where(np.isfinite(rays.range)[:, None], np.minimum(miss, _MOST_RANGE_COST), 0.0)
    cost = np.where(rays.label[:, None] == labels, deviation - gain, STRAY_RAY)
    return np.asarray(cost.min(axis=2, initial=STRAY_RAY).sum(axis=1))


def _steps(sigma: float, finest: float, most: int) -> Floats:
    """Return the grid values along one axis, 0 among them. finest: the least step. most: the largest number of values."""
    half = int(min(np.ceil(_GRID_SIGMAS * sigma / finest), most // 2))
    return np.linspace(-_GRID_SIGMAS * sigma, _GRID_SIGMAS * sigma, 2 * half + 1) if half else np.zeros(1)
