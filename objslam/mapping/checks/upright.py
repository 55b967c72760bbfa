"""A check of the map's frame: whether its z axis points up."""

import numpy as np

from objslam.core.geometry import is_planar
from objslam.core.types import Keyframes

_STEADY = 0.7
"""The least length of the mean of the cameras' unit up vectors. A smaller value also judges cameras that roll about."""
_TILT = np.radians(45)
"""The angle, rad, between this mean and the map's z axis above which the map lies on its side. Cameras on robots look up or
down by less. A larger angle warns less often."""


def lies_on_its_side(keyframes: Keyframes) -> str | None:
    """Return a warning if the cameras' mean up vector is far from the map's z axis, as after visual SLAM; None otherwise.

    There is no warning for a planar path, because its plane shows where up is.
    """
    if not len(keyframes) or is_planar(keyframes.map_T_base):
        return None
    up = -keyframes.map_T_camera[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < _STEADY or np.arccos(np.clip(up[2] / length, -1.0, 1.0)) <= _TILT:
        return None
    axis = int(np.argmax(np.abs(up)))
    name = ("-" if up[axis] < 0 else "") + "xyz"[axis]
    return (
        f"the map lies on its side: the cameras' up is {name}, not z, so map.png shows it from the side and heights are "
        "not z (turn the poses so that z points up)"
    )
