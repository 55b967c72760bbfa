"""The rotation and the size of a fiducial, and its values in a table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.rotation import quaternion_from_rotation, rotation_from_quaternion

TAG_COLUMNS = dict.fromkeys(
    ("tag_qx", "tag_qy", "tag_qz", "tag_qw", "tag_sigma_deg", "tag_size", "tag_size_sigma"), "float64"
)
"""The columns of a fiducial in a table of objects, with their types. Sizes are in m."""
_SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])


@dataclass(frozen=True)
class TagPose:
    """The rotation and the size of one fiducial. Its position is the position of its object.

    xyzw: (4,) the unit quaternion of map_R_tag: x from the first corner to the second, z from the tag to the viewer.
    covariance: (3, 3) rad^2, of the error of the rotation as a rotation vector in the frame of the tag. size: m, the side.
    size_sigma: m, its standard deviation, 0 for a given size that counts as exact. other_xyzw: (4,) a second rotation at
    which a flat square looks nearly the same, None if the views rule it out. other_probability: the probability of the
    second rotation, 0 without one.
    """

    xyzw: Floats
    covariance: Floats
    size: float
    size_sigma: float
    other_xyzw: Floats | None = None
    other_probability: float = 0.0

    @property
    def rotation(self) -> Floats:
        """(3, 3) map_R_tag."""
        return rotation_from_quaternion(self.xyzw[None])[0]

    @property
    def other(self) -> Floats | None:
        """(3, 3) the second rotation, None without one."""
        return None if self.other_xyzw is None else rotation_from_quaternion(self.other_xyzw[None])[0]

    def outline(self, position: Floats) -> Floats:
        """Return the closed outline (5, 3), m in map, of the fiducial at a position (3,)."""
        return np.asarray(position + self.size * _SQUARE[[0, 1, 2, 3, 0]] @ self.rotation.T)

    @property
    def sigma_deg(self) -> float:
        """The standard deviation of the rotation about its least certain axis, degrees."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1])))

    def turned(self, rotation: Floats, yaw_sigma: float = 0.0) -> Self:
        """Return the fiducial after `rotation` (3, 3) turned its map. yaw_sigma: rad, the standard deviation of this
        rotation's yaw."""
        up = (rotation @ self.rotation)[2]
        return replace(
            self,
            xyzw=_quaternion(rotation @ self.rotation),
            covariance=self.covariance + yaw_sigma**2 * np.outer(up, up),
            other_xyzw=None if self.other is None else _quaternion(rotation @ self.other),
        )


def tag_entry(tag: TagPose) -> dict[str, Any]:
    """Return the values of a fiducial for JSON."""
    entry: dict[str, Any] = {
        "rotation_xyzw": tag.xyzw.tolist(),
        "rotation_covariance": tag.covariance.tolist(),
        "size": tag.size,
        "size_sigma": tag.size_sigma,
    }
    if tag.other_xyzw is not None:
        entry["other_rotation_xyzw"] = tag.other_xyzw.tolist()
        entry["other_probability"] = tag.other_probability
    return entry


def tag_row(tag: TagPose | None) -> tuple[float | None, ...]:
    """Return the values of a fiducial in a table row."""
    if tag is None:
        return (None,) * len(TAG_COLUMNS)
    return (*tag.xyzw.tolist(), tag.sigma_deg, tag.size, tag.size_sigma)


def _quaternion(rotation: Floats) -> Floats:
    return quaternion_from_rotation(rotation[None])[0]
