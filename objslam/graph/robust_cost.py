"""The cost of a solution, and the information that rays give about landmarks.

The cost of a ray has an upper bound. So the costs of solutions with different inliers can be compared.
"""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import angles_off, inverse, log_se3
from objslam.core.statistics import STRAY_RAY
from objslam.core.types import Rays

FLOOR = 0.02
"""Rays miss a landmark by this standard deviation (m), because the centres of boxes are not one point of the object. With a
larger value, rays may miss near landmarks by more."""


def truncated_cost(
    rays: Rays, owner: Ints, positions: Floats, map_T_camera: Floats, motion: Floats, covariance: Floats
) -> float:
    """Return the sum of the squared deviations of the rays and of the odometry. A ray costs `STRAY_RAY` at most.

    owner: (R,) index into positions (N, 3), or -1 for a ray that does not count. map_T_camera: (K, 4, 4) of the first K
    keyframes. Later keyframes do not count. motion, covariance: (M, 4, 4), (M, 6, 6) camera motions by odometry.
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
    """Return the information (N, 3, 3), m^-2, that rays give about the position of each of `count` landmarks.

    directions: (R, 3) unit, in map. across, along: (R,) m^-2, the information across and along each ray. The information
    along a ray without a range is 0. landmark: (R,) index of the ray's landmark.
    """
    outer = directions[:, :, None] * directions[:, None, :]
    one = (np.eye(3) - outer) * across[:, None, None] + outer * along[:, None, None]
    total = np.zeros((count, 3, 3))
    np.add.at(total, landmark, one)
    return total
