"""Find the frames in which a standing robot shows the same view again.

All rays from one place meet, also with a wrong pose of the camera on the robot. So the frames of a robot that stands for
minutes would hide this wrong pose. Their false boxes would also outnumber the boxes from which points can be computed."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import interpolate
from objslam.core.types import Log

_STEP, _TURN = 0.05, np.radians(2.0)
"""The largest distance (m) and angle (rad) of a standing robot from the pose at which it came to rest. Localisations of
robots at rest jitter by a few centimetres. With larger values, slow motions count as rest."""
_SECONDS = 2.0
"""The shortest duration (s) of a standstill. A robot that drives at 0.025 m/s or more leaves `_STEP` within this time, so it
never stands. A larger value finds fewer standstills."""


def repeated_views(log: Log, stamps: Floats, settings: Settings) -> Bools:
    """Return a mask (F,) of the frames that show what an earlier frame of the same standstill shows.

    The robot stands if each path of the log says so. The paths are the localisation and the odometry. A frame outside of
    these paths, or in a gap, is not repeated. stamps: (F,) s, the increasing times of the frames of one camera. The camera
    must not move on the robot.
    """
    motion, known = [], np.ones(len(stamps), dtype=bool)
    for path in (log.localization, log.odometry):
        if path is not None:
            poses, valid = interpolate(path.stamps, path.poses, stamps, settings.poses.max_gap)
            known &= valid
            # The chord between two rotation matrices is sqrt(8) sin(angle / 2).
            turned = poses[:, :3, :3].reshape(-1, 9) / (np.sqrt(8) * np.sin(_TURN / 2))
            motion.append(np.concatenate([poses[:, :3, 3] / _STEP, turned], axis=1))
    repeated = np.zeros(len(stamps), dtype=bool)
    begin = 0  # Each standstill begins where the one before ends, so this is a loop over frames, which are a few hundred.
    while begin < len(stamps) and motion:
        end = begin + 1
        at = [path[begin] for path in motion]
        while end < len(stamps) and known[end] and _is_at(motion, at, end):
            end += 1
        if known[begin] and stamps[end - 1] - stamps[begin] > _SECONDS:
            repeated[begin + 1 : end] = True
        begin = end
    return repeated


def _is_at(motion: list[Floats], at: list[Floats], frame: int) -> bool:
    """Return whether a frame has the pose `at` in each path, within `_STEP` and `_TURN`."""
    apart = [path[frame] - pose for path, pose in zip(motion, at, strict=True)]
    return all(one[:3] @ one[:3] <= 1 and one[3:] @ one[3:] <= 1 for one in apart)
