"""How well poses and landmarks explain a drive, in a measure that compares solutions with different rays in them."""

from __future__ import annotations

import numpy as np

from objslam.geometry import inverse, log_se3
from objslam.rays import angles_off
from objslam.types import Floats, Ints, Rays

STRAY = 13.8  # squared deviations that a ray costs at the most
FLOOR = 0.02  # m; landmarks are never taken to be known better than that


def truncated_cost(
    rays: Rays, owner: Ints, positions: Floats, map_T_camera: Floats, motion: Floats, covariance: Floats
) -> float:
    """Squared deviations of all rays (R,) with a landmark, none more than a stray's, and of the odometry, up to here.

    owner: (R,) index into positions (N, 3), -1 none. map_T_camera: (K, 4, 4), the first of the keyframes. motion (M, 4, 4)
    and covariance (M, 6, 6) between them, by odometry.
    """
    held = np.flatnonzero((owner >= 0) & (rays.keyframe < len(map_T_camera)))
    some = rays.take(held)
    origins, directions = some.in_map(map_T_camera)
    off = angles_off(origins, directions, positions[owner[held]])
    distance = np.linalg.norm(positions[owner[held]] - origins, axis=1)
    seen = np.minimum(off**2 / (some.sigma**2 + (FLOOR / distance) ** 2), STRAY).sum()
    steps = len(map_T_camera) - 1
    twist = log_se3(inverse(motion[:steps]) @ inverse(map_T_camera[:-1]) @ map_T_camera[1:])
    return float(seen + (twist * np.linalg.solve(covariance[:steps], twist[..., None])[..., 0]).sum())
