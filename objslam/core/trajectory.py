"""Poses over time, and corrections of a whole path, derived from the corrections of its keyframes."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, need
from objslam.core.geometry import interpolate, inverse, log_se3, twist_lengths
from objslam.core.rotation import rotation_vector

_SPAN = 0.4
"""The time, s, over which a speed is averaged. It spans several poses of slow odometry. A longer time smooths more."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of one coordinate frame in another over time.

    stamps: (N,) s, finite, strictly increasing. poses: (N, 4, 4) homogeneous, finite. travel: (N, 3) what the function
    `travel` returns, summed over all measured poses since the previous pose. None if no measured pose was left out.
    ValueError if an array is not as described.
    """

    stamps: Floats
    poses: Floats
    travel: Floats | None = None

    def __post_init__(self) -> None:
        n = len(self.stamps)
        need(self.stamps.shape == (n,) and self.poses.shape == (n, 4, 4), "a trajectory needs (N,) stamps, (N, 4, 4) poses")
        need(self.travel is None or self.travel.shape == (n, 3), "a trajectory needs (N, 3) travel")
        need(np.isfinite(self.stamps).all() and np.isfinite(self.poses).all(), "the values of a trajectory must be finite")
        need((np.diff(self.stamps) > 0).all(), "the stamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.stamps)


def rates(path: Trajectory, stamps: Floats) -> tuple[Floats, Floats]:
    """Return the speed (K,), m/s, and the turn rate to the left (K,), rad/s, of a path at stamps (K,), s.

    Both are means over 0.4 s, or over less at an end of the path. A path of one pose gives 0 for both.
    """
    begin, end = (np.clip(stamps + half, path.stamps[0], path.stamps[-1]) for half in (-_SPAN / 2, _SPAN / 2))
    before, after = (interpolate(path.stamps, path.poses, at, np.inf)[0] for at in (begin, end))
    twist = log_se3(inverse(before) @ after)
    span = end - begin
    moved = np.stack([np.linalg.norm(twist[:, 3:], axis=1), twist[:, 2]])
    speed, turn = np.divide(moved, span, out=np.zeros_like(moved), where=span > 0)
    return speed, turn


def usual_seconds(seconds: Floats) -> Floats:
    """Return the times (N, ...), s, of the steps of a path, none of them shorter than the median.

    If poses are stamped at their arrival, poses that had to wait arrive in a group. Steps inside a group seem to take no
    time.
    """
    return np.maximum(seconds, np.median(seconds))


def travel(poses: Floats) -> Floats:
    """Return how far a path with poses (N, 4, 4) goes from each pose to the next: (N - 1, 3).

    The columns are the length of the way (m), the size of the turn (rad), and the signed turn about the vertical axis (rad).
    If poses are left out, the row of the longer step is the sum of the rows of the steps that it replaces.
    """
    turn, way = twist_lengths(inverse(poses[:-1]) @ poses[1:])
    rotation = poses[:, :3, :3]
    return np.stack([way, turn, rotation_vector(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))[:, 2]], axis=1)


def correct_path(path: Trajectory, stamps: Floats, before: Floats, after: Floats) -> Trajectory:
    """Correct a path by keyframes at `stamps` (K,), s, whose poses the solve changed from `before` to `after` (K, 4, 4)."""
    return Trajectory(path.stamps, correct_poses(path.stamps, path.poses, stamps, before, after))


def correct_poses(stamps: Floats, poses: Floats, keyframe_stamps: Floats, before: Floats, after: Floats) -> Floats:
    """Correct poses (N, 4, 4) at stamps (N,), s, by keyframes, whose poses the solve changed from `before` to `after`
    (K, 4, 4).

    keyframe_stamps: (K,) s. The correction is interpolated between keyframes. Before the first and after the last keyframe
    it is constant.
    """
    known, first = np.unique(keyframe_stamps, return_index=True)
    correction = after[first] @ inverse(before[first])
    at, _ = interpolate(known, correction, np.clip(stamps, known[0], known[-1]), np.inf)
    return at @ poses


def poses_near(path: Trajectory, stamps: Floats, max_gap: float) -> Floats:
    """Return the poses (Q, 4, 4) of a path at stamps (Q,), s.

    A stamp beyond an end of the path, or in a gap longer than `max_gap`, s, takes the nearest pose.
    """
    at, last = path.stamps, len(path.stamps) - 1
    known = np.clip(stamps, at[0], at[-1])
    index = np.clip(np.searchsorted(at, known), 1, max(last, 1))
    before, after = at[index - 1], at[np.minimum(index, last)]
    nearest = np.where(known - before < after - known, before, after)
    return interpolate(at, path.poses, np.where(after - before > max_gap, nearest, known), np.inf)[0]
