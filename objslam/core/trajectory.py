"""A path moved as its keyframes were."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.core.types import Trajectory


def correct_path(path: Trajectory, stamps: Floats, before: Floats, after: Floats) -> Trajectory:
    """The whole path, moved as its keyframes were: at their stamps (K,) from poses before to poses after, (K, 4, 4) each."""
    return Trajectory(path.stamps, correct_poses(path.stamps, path.poses, stamps, before, after))


def correct_poses(stamps: Floats, poses: Floats, keyframe_stamps: Floats, before: Floats, after: Floats) -> Floats:
    """Poses (N, 4, 4) at stamps (N,), moved as the keyframes at theirs (K,) were: from before to after, (K, 4, 4) each.

    Between two keyframes the correction goes over from the one's to the other's; beyond the first and last it stays.
    """
    known, first = np.unique(keyframe_stamps, return_index=True)
    correction = after[first] @ inverse(before[first])
    at, _ = interpolate(known, correction, np.clip(stamps, known[0], known[-1]), np.inf)
    return at @ poses
