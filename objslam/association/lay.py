"""Rays of a short stretch laid onto known landmarks as a whole: the small planar correction that explains most of them."""

from __future__ import annotations

import numpy as np

from objslam.geometry import lift_se2
from objslam.types import Floats, Ints, Rays

_GRID = 3.0  # standard deviations to either side
_TURNS, _SHIFTS = 25, 9  # steps of the grid at the most
_FINE_TURN, _FINE_SHIFT = np.radians(0.4), 0.04  # rad, m; no finer
_POINT = 0.03  # m; by how much a landmark is off
_STRAY = 13.8  # what a ray costs that fits none, in squared deviations (chi-squared, 2 degrees of freedom, 0.999)
_STEEP = 0.1  # cosine of a ray's elevation; a steeper one tells hardly any heading
_AT_ONCE = 2_000_000  # distances in memory
_RANGE = 9.0  # what a range costs at the most: it may be wrong


def lay(rays: Rays, positions: Floats, labels: Ints, map_T_camera: Floats, centre: Floats, spread: Floats) -> Floats:
    """The correction (4, 4), in map, of the cameras of these rays; planar, about the place `centre` (3,).

    positions: (N, 3) m and labels: (N,) of the landmarks. spread: (3,) standard deviations of x, y (m) and yaw (rad) in map:
    how far the correction may go, and its prior. Every ray costs its squared deviation from the landmark that it fits best,
    or that of a stray.
    """
    steps = (_steps(spread[0], _FINE_SHIFT, _SHIFTS), _steps(spread[1], _FINE_SHIFT, _SHIFTS))
    grid = np.stack(np.meshgrid(*steps, _steps(spread[2], _FINE_TURN, _TURNS), indexing="ij"), axis=-1).reshape(-1, 3)
    cost = ((grid / np.maximum(spread, 1e-6)) ** 2).sum(axis=1)
    size = max(1, _AT_ONCE // max(1, len(rays) * len(positions)))
    for begin in range(0, len(grid), size):
        part = slice(begin, begin + size)
        cost[part] += _misfit(rays, positions, labels, map_T_camera, centre, grid[part])
    correction = lift_se2(grid[np.argmin(cost)])
    correction[:3, 3] += centre - correction[:3, :3] @ centre
    return correction


def _misfit(
    rays: Rays, positions: Floats, labels: Ints, map_T_camera: Floats, centre: Floats, corrections: Floats
) -> Floats:
    """What all rays cost under corrections (H, 3): (H,)."""
    origin, direction = rays.in_map(map_T_camera)
    offset, level = origin - centre, np.hypot(direction[:, 0], direction[:, 1])
    cos, sin = np.cos(corrections[:, 2, None]), np.sin(corrections[:, 2, None])
    x = centre[0] + corrections[:, :1] + cos * offset[:, 0] - sin * offset[:, 1]
    y = centre[1] + corrections[:, 1:2] + sin * offset[:, 0] + cos * offset[:, 1]
    heading = np.arctan2(direction[:, 1], direction[:, 0]) + corrections[:, 2, None]
    dx, dy = positions[:, 0] - x[..., None], positions[:, 1] - y[..., None]  # (H, R, N)
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    angle = (np.arctan2(dy, dx) - heading[..., None] + np.pi) % (2 * np.pi) - np.pi
    sigma = (rays.sigma / np.maximum(level, _STEEP))[:, None]
    deviation = angle**2 / (sigma**2 + (_POINT / distance) ** 2)
    miss = (distance - (rays.range * level)[:, None]) ** 2 / (rays.range_sigma**2 + _POINT**2)[:, None]
    deviation += np.where(np.isfinite(rays.range)[:, None], np.minimum(miss, _RANGE), 0.0)
    same = rays.label[:, None] == labels
    return np.asarray(np.where(same, deviation, _STRAY).min(axis=2, initial=_STRAY).sum(axis=1))


def _steps(sigma: float, finest: float, most: int) -> Floats:
    """From -3 to 3 standard deviations, zero among them."""
    half = int(min(np.ceil(_GRID * sigma / finest), most // 2))
    return np.linspace(-_GRID * sigma, _GRID * sigma, 2 * half + 1) if half else np.zeros(1)
