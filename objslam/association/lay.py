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
_RANGE = 9.0  # what a range costs at the most: it may be wrong


def lay(rays: Rays, positions: Floats, labels: Ints, map_T_camera: Floats, covariance: Floats, pivot: int) -> Floats:
    """The correction (4, 4), in map, of the cameras of these rays; planar, about the camera of keyframe `pivot`.

    positions: (N, 3) m and labels: (N,) of the landmarks. covariance: (6, 6) of the cameras, rotation first, in their own
    frame: how far the correction may go, and its prior. Every ray costs its squared deviation from the landmark that it fits
    best, or that of a stray.
    """
    axes = map_T_camera[pivot, :3, :3]
    yaw = float(np.sqrt(max((axes @ covariance[:3, :3] @ axes.T)[2, 2], 0.0)))
    place = np.sqrt(np.maximum(np.diag(axes @ covariance[3:, 3:] @ axes.T)[:2], 0.0))
    steps = (_steps(place[0], _FINE_SHIFT, _SHIFTS), _steps(place[1], _FINE_SHIFT, _SHIFTS), _steps(yaw, _FINE_TURN, _TURNS))
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    cost = ((grid / np.maximum([*place, yaw], 1e-6)) ** 2).sum(axis=1)
    centre = map_T_camera[pivot, :3, 3]
    origin, direction = rays.in_map(map_T_camera)
    same = rays.label[:, None] == labels
    cos, sin = np.cos(grid[:, 2, None]), np.sin(grid[:, 2, None])
    offset = origin - centre
    x = centre[0] + grid[:, :1] + cos * offset[:, 0] - sin * offset[:, 1]
    y = centre[1] + grid[:, 1:2] + sin * offset[:, 0] + cos * offset[:, 1]
    heading = np.arctan2(direction[:, 1], direction[:, 0]) + grid[:, 2, None]
    level = np.hypot(direction[:, 0], direction[:, 1])
    for r in range(len(rays)):
        if not same[r].any():
            cost += _STRAY
            continue
        to = positions[same[r], :2]
        dx, dy = to[:, 0] - x[:, r, None], to[:, 1] - y[:, r, None]
        distance = np.maximum(np.hypot(dx, dy), 1e-6)
        angle = (np.arctan2(dy, dx) - heading[:, r, None] + np.pi) % (2 * np.pi) - np.pi
        deviation = angle**2 / ((rays.sigma[r] / max(level[r], 0.1)) ** 2 + (_POINT / distance) ** 2)
        if np.isfinite(rays.range[r]):
            miss = (distance - rays.range[r] * level[r]) ** 2 / (rays.range_sigma[r] ** 2 + _POINT**2)
            deviation = deviation + np.minimum(miss, _RANGE)
        cost += np.minimum(deviation.min(axis=1), _STRAY)
    correction = lift_se2(grid[np.argmin(cost)])
    correction[:3, 3] += centre - correction[:3, :3] @ centre
    return correction


def _steps(sigma: float, finest: float, most: int) -> Floats:
    """From -3 to 3 standard deviations, zero among them."""
    half = int(min(np.ceil(_GRID * sigma / finest), most // 2))
    return np.linspace(-_GRID * sigma, _GRID * sigma, 2 * half + 1) if half else np.zeros(1)
