"""The fields of journal records, with the limits that a live session puts on them."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.validity import is_name, rigid_pose, valid_stamps


def as_stamp(value: float) -> float:
    """Return a stamp, s. Raises ValueError if no session accepts it."""
    if not valid_stamps(np.array(value, dtype=np.float64)):
        raise ValueError("a stamp is not finite or too large")
    return float(value)


def as_name(value: object) -> str:
    """Return a name. Raises ValueError if it is empty or not printable."""
    if not is_name(value):
        raise ValueError("a name that is empty or not printable")
    return str(value)


def as_count(value: object) -> int:
    """Return a whole number of at least 0. Raises ValueError for anything else."""
    if type(value) is not int or value < 0:
        raise ValueError("a count is not a whole number")
    return value


def as_pose(values: list[float]) -> Floats:
    """Return a pose (4, 4) of 16 numbers. Raises ValueError if it is not rigid, or too far away."""
    pose = rigid_pose(as_array(values, (4, 4)))
    if pose is None:
        raise ValueError("a pose that is not rigid, or too far away")
    return pose


def as_array(values: list[float], shape: tuple[int, ...]) -> Floats:
    """Return an array of this shape. Raises ValueError if the numbers do not fit, or are not finite."""
    found = np.array(values, dtype=np.float64).reshape(shape)
    if not np.isfinite(found).all():
        raise ValueError("a number is not finite")
    return found
