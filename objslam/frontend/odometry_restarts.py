"""Recognise odometry that restarted in a gap: it counts from zero again."""

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.rotation import rotation_vector

_ZERO = 0.05
"""After a restart, the odometry is nearer to zero than this (m and rad). A larger value finds more restarts."""
_FAR = 0.1
"""Before a restart, the odometry was at least this far from zero (m or rad). Nearer, a restart changes little. A larger
value finds fewer restarts."""


def counts_from_zero(before: Floats, after: Floats) -> Bools:
    """Return whether odometry counts from zero again, for its poses (..., 4, 4) before and after a gap."""
    return np.asarray((_from_zero(after) < _ZERO) & (_from_zero(before) > _FAR))


def _from_zero(poses: Floats) -> Floats:
    """Return the angle (rad) or the distance (m) from zero of poses (..., 4, 4), whichever is the larger number."""
    angle = np.linalg.norm(rotation_vector(poses[..., :3, :3].reshape(-1, 3, 3)), axis=1).reshape(poses.shape[:-2])
    return np.asarray(np.maximum(angle, np.linalg.norm(poses[..., :3, 3], axis=-1)))
