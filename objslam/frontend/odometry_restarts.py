"""Recognise odometry that restarted in a gap, so that its poses begin at zero again."""

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.rotation import rotation_vector

_ZERO = 0.05
"""The largest distance (m) and angle (rad) of the odometry from zero after a restart. A larger value finds more restarts."""
_FAR = 0.1
"""The least distance (m) or angle (rad) of the odometry from zero before a restart. From a smaller distance or angle, a
restart changes little. A larger value finds fewer restarts."""


def counts_from_zero(before: Floats, after: Floats) -> Bools:
    """Return whether odometry begins at zero again after a gap. before, after: (..., 4, 4) its poses before and after the
    gap."""
    return np.asarray((_from_zero(after) < _ZERO) & (_from_zero(before) > _FAR))


def _from_zero(poses: Floats) -> Floats:
    """Return the angle (rad) or the distance (m) from zero of poses (..., 4, 4), whichever is the larger number."""
    angle = np.linalg.norm(rotation_vector(poses[..., :3, :3].reshape(-1, 3, 3)), axis=1).reshape(poses.shape[:-2])
    return np.asarray(np.maximum(angle, np.linalg.norm(poses[..., :3, 3], axis=-1)))
