"""How well poses and landmarks explain a drive, in a measure that compares solutions with different rays in them."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import angles_off, inverse, log_se3
from objslam.core.statistics import STRAY_RAY
from objslam.core.types import Rays

FLOOR = 0.02
"""The standard deviation (m) that every landmark has at least, for a box's centre is not a point of its object; larger lets
rays miss nearby landmarks by more."""


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
    seen = np.minimum(off**2 / (some.sigma**2 + (FLOOR / distance) ** 2), STRAY_RAY).sum()
    steps = len(map_T_camera) - 1
    twist = log_se3(inverse(motion[:steps]) @ inverse(map_T_camera[:-1]) @ map_T_camera[1:])
    return float(seen + (twist * np.linalg.solve(covariance[:steps], twist[..., None])[..., 0]).sum())


def ray_information(directions: Floats, across: Floats, along: Floats, landmark: Ints, count: int) -> Floats:
    """The information (N, 3, 3), m^-2, that rays have about landmarks where they are.

    Args:
        directions: (R, 3) unit, in map.
        across, along: (R,) m^-2, the information of each across and along its ray; 0 along where it has no range.
        landmark: (R,) that of each ray, below count.
    """
    outer = directions[:, :, None] * directions[:, None, :]
    one = (np.eye(3) - outer) * across[:, None, None] + outer * along[:, None, None]
    total = np.zeros((count, 3, 3))
    np.add.at(total, landmark, one)
    return total
