"""Corrections of a whole path, derived from the corrections of its keyframes."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.core.types import Trajectory


def correct_path(path: Trajectory, stamps: Floats, before: Floats, after: Floats) -> Trajectory:
    """Correct a path by its keyframes, which moved at `stamps` (K,) from poses `before` to poses `after` (K, 4, 4)."""
    return Trajectory(path.stamps, correct_poses(path.stamps, path.poses, stamps, before, after))


def correct_poses(stamps: Floats, poses: Floats, keyframe_stamps: Floats, before: Floats, after: Floats) -> Floats:
    """Correct poses (N, 4, 4) at stamps (N,) by keyframes, which moved from poses `before` to poses `after` (K, 4, 4).

    The correction is interpolated between keyframes. Before the first and after the last keyframe it is constant.
    """
    known, first = np.unique(keyframe_stamps, return_index=True)
    correction = after[first] @ inverse(before[first])
    at, _ = interpolate(known, correction, np.clip(stamps, known[0], known[-1]), np.inf)
    return at @ poses
