"""Conversion of a user's arrays to the arrays of the data types. A wrong value raises a ValueError that names the row."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import lift_se2, pose_from_quaternion
from objslam.core.validity import rigid_poses, valid_pose_rows, valid_stamps


def as_poses(values: ArrayLike) -> Floats:
    """Return poses (N, 4, 4). values: matrices (N, 4, 4), or rows (N, 3) of x, y, yaw, or rows (N, 7) of x, y, z, qx, qy,
    qz, qw.

    Units are m and rad. ValueError for another shape, or if a pose is not finite, not rigid or too far away.
    """
    given = np.asarray(values, dtype=np.float64)
    if given.shape[1:] == (4, 4):
        poses, good = rigid_poses(given)
    elif given.shape[1:] == (7,):
        good = valid_pose_rows(given)
        rows = np.where(good[:, None], given, [0, 0, 0, 0, 0, 0, 1.0])
        poses = pose_from_quaternion(rows[:, :3], rows[:, 3:])
    elif given.shape[1:] == (3,):
        poses, good = rigid_poses(lift_se2(given))
    else:
        raise ValueError(f"poses are (N, 3) x, y, yaw, (N, 7) x, y, z, qx, qy, qz, qw, or (N, 4, 4), got {given.shape}")
    _all_good(good, "pose", "is not finite, too far away or not rigid")
    return poses


def as_pose(values: ArrayLike) -> Floats:
    """Return one pose (4, 4). values: a matrix (4, 4), or a row (3,) or (7,) as for `as_poses`. ValueError if the values are
    not a valid pose."""
    return as_poses(np.asarray(values, dtype=np.float64)[None])[0]


def as_stamps(values: ArrayLike) -> Floats:
    """Return the stamps (N,), s, as an array. ValueError if the shape is not (N,), or if the stamps are not finite or do not
    increase."""
    stamps = np.asarray(values, dtype=np.float64)
    if stamps.ndim != 1:
        raise ValueError(f"stamps are (N,) seconds, got the shape {stamps.shape}")
    _all_good(valid_stamps(stamps), "stamp", "is not a finite number of seconds")
    _all_good(np.diff(stamps, prepend=-np.inf) > 0, "stamp", "is not later than the one before it")
    return stamps


def as_boxes(values: ArrayLike, where: str) -> Floats:
    """Return the boxes (B, 4) of one frame: x1, y1, x2, y2 in px. An empty list gives (0, 4). where: the name of the frame
    for messages. ValueError for another shape."""
    given = np.asarray(values, dtype=np.float64)
    if given.size and given.shape[1:] != (4,):
        raise ValueError(f"{where}: boxes are (B, 4) x1, y1, x2, y2, got the shape {given.shape}")
    return given.reshape(-1, 4)


def per_box(values: Sequence[ArrayLike] | None, counts: Sequence[int], unknown: float, name: str) -> Floats:
    """Return the numbers (M,), one for each of the M boxes of all frames. values: one list for each frame, with one number
    for each of its boxes. Without `values`, each number is `unknown`.

    counts: the number of boxes of each frame. name: the name of `values` for messages. ValueError if the lengths of the
    lists differ from `counts`.
    """
    if values is None:
        return np.full(sum(counts), unknown)
    lists = [np.asarray(one, dtype=np.float64).reshape(-1) for one in values]
    if [len(one) for one in lists] != list(counts):
        raise ValueError(f"{name} needs one list for each frame, with one number for each of its boxes")
    return np.concatenate([*lists, np.zeros(0)])


def _all_good(good: Bools, what: str, fault: str) -> None:
    if not good.all():
        raise ValueError(f"{what} {int(np.argmin(good))} {fault}")
