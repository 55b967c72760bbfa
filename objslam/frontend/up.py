"""Find the axis of a map that points up, from the poses of its cameras, and the axes of a view from above."""

from collections.abc import Mapping
from typing import get_args

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import is_planar
from objslam.core.types import Keyframes, Up

_STEADY = 0.7
"""The least length of the mean of the cameras' unit up vectors. If the mean is shorter, the cameras roll too much to show
where up is, and z is used. With a larger value, z is used more often."""
_TILT = np.radians(45)
"""The angle, rad, between the mean of the up vectors and the map's z axis, above which the map lies on its side. Cameras on
robots look up or down by less. With a larger angle, z is used more often."""
_CLIMB = 2.0
"""The ratio of the cameras' motion along an axis to their motion along the map's z axis, above which the axis does not point
up. Robots move mostly on the floor. A camera that looks straight down has a level up vector, which does not show where up
is. With a larger number, the up vectors count in more maps."""
_FROM_ABOVE = {"z": (0, 1), "-z": (1, 0), "x": (1, 2), "-x": (2, 1), "y": (2, 0), "-y": (0, 2)}
"""For each axis that can point up: the two axes that point to the right and to the top of a view from above. Together with
the axis that points up, they are a right-handed frame."""


def up_axis(keyframes: Keyframes) -> Up:
    """Return the axis of the map that points up. This is z, unless the map lies on its side.

    For a map on its side, it is the axis that is nearest to the mean of the cameras' up vectors. The map of visual SLAM is
    often in the first camera's frame, where y points down. If the path is planar, or the cameras move mostly along that
    axis, up is z.
    """
    if not len(keyframes) or is_planar(keyframes.map_T_base):
        return "z"
    up = -keyframes.map_T_camera[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < _STEADY or np.arccos(np.clip(up[2] / length, -1.0, 1.0)) <= _TILT:
        return "z"
    axis = int(np.argmax(np.abs(up)))
    way = np.ptp(keyframes.map_T_camera[:, :3, 3], axis=0)
    if way[axis] > _CLIMB * way[2]:
        return "z"
    return get_args(Up)[axis + 3 * bool(up[axis] < 0)]


def on_its_side(ups: Mapping[str, Up]) -> str | None:
    """Return why maps cannot be matched, None if they can. A map on its side cannot. ups: the axis that points up, by name
    of map."""
    for name, up in ups.items():
        if up != "z":
            return f"{name} lies on its side (up is {up}); maps are matched only with z up"
    return None


def from_above(up: Up) -> list[int]:
    """Return the two axes that point to the right and to the top of a view from above."""
    return list(_FROM_ABOVE[up])


def up_vector(up: Up) -> Floats:
    """Return the unit vector (3,) in map of the axis that points up."""
    return np.eye(3)["xyz".index(up[-1])] * (-1.0 if up.startswith("-") else 1.0)


def upright(keyframes: Keyframes) -> Floats:
    """Return the rotation (3, 3) from the map to new axes. The first two are level, and the third one points up."""
    up = up_axis(keyframes)
    return np.stack([*np.eye(3)[from_above(up)], up_vector(up)])
