"""Read the fields of journal records, and refuse the values that a live session would refuse."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.validity import is_name, rigid_pose, valid_stamps


def as_stamp(value: float) -> float:
    """Return a stamp, s. Raises ValueError if the stamp is not finite or too large."""
    if not valid_stamps(np.array(value, dtype=np.float64)):
        raise ValueError("a stamp is not finite or too large")
    return float(value)


def as_name(value: object) -> str:
    """Return a name. Raises ValueError if the name is empty or not printable."""
    if not is_name(value):
        raise ValueError("a name that is empty or not printable")
    return str(value)


def as_count(value: object) -> int:
    """Return a whole number of at least 0. Raises ValueError for anything else."""
    if type(value) is not int or value < 0:
        raise ValueError("a count is not a whole number")
    return value


def as_pose(values: list[float]) -> Floats:
    """Return the pose (4, 4) of 16 numbers. Raises ValueError if the pose is not rigid or too far away."""
    pose = rigid_pose(as_array(values, (4, 4)))
    if pose is None:
        raise ValueError("a pose that is not rigid, or too far away")
    return pose


def as_array(values: list[float], shape: tuple[int, ...]) -> Floats:
    """Return the numbers as an array of this shape. Raises ValueError if their count is wrong or a number is not finite."""
    found = np.array(values, dtype=np.float64).reshape(shape)
    if not np.isfinite(found).all():
        raise ValueError("a number is not finite")
    return found
