"""The camera of a user: a calibration that is checked when it is made. Its base class is in `core.camera`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.core import camera
from objslam.core.validity import camera_fault

_OUTSIDE = 10.0
"""How far outside the image a principal point may be, as a multiple of the image's size. If the image is a small part cut
out of another image, its principal point is outside by a few sizes. A larger multiple accepts more wrong numbers."""


@dataclass(frozen=True)
class Camera(camera.Camera):
    """A calibrated camera with the fields of ROS camera_info, and its pose on the robot.

    Args:
        name: of the camera.
        width, height: of the image, px.
        matrix: (3, 3) px, with the rows fx 0 cx, 0 fy cy, 0 0 1.
        distortion_model: plumb_bob, rational_polynomial or equidistant.
        distortion: its coefficients, no distortion by default.
        base_T_camera: (4, 4) the pose of the optical frame (z ahead, x right, y down) in base.
        depth_scale: the units of a depth image per metre.
        sees_size: whether the boxes show how large the objects are.
        depth_noise: the noise of its depths, None for the noise in the settings.
    Raises:
        ValueError: no camera has such a calibration. The message names the fault.
    """

    def __post_init__(self) -> None:
        for name, value in checked_arrays(self).items():
            object.__setattr__(self, name, value)
        if (fault := camera_fault(self) or self._far_centre()) is not None:
            raise ValueError(f"camera {self.name!r} {fault}")

    def _far_centre(self) -> str | None:
        centre = self.matrix[:2, 2]
        if ((centre >= -_OUTSIDE * self.size) & (centre <= (1 + _OUTSIDE) * self.size)).all():
            return None
        place, size = f"({centre[0]:g}, {centre[1]:g}) px", f"{self.width} x {self.height} px"
        return f"whose principal point {place} is far outside its image of {size}"


def as_camera(given: camera.Camera) -> Camera:
    """Return a camera whose calibration is checked. ValueError names what is wrong with it."""
    if isinstance(given, Camera):
        return given
    return Camera(**{name: getattr(given, name) for name in camera.Camera.__dataclass_fields__})


def checked_arrays(given: camera.Camera) -> dict[str, Any]:
    """Return the matrix, the distortion and base_T_camera as arrays. ValueError names an array of a wrong shape."""
    found = {name: np.asarray(getattr(given, name), dtype=np.float64) for name in ("matrix", "distortion", "base_T_camera")}
    for name, shape in (("matrix", (3, 3)), ("base_T_camera", (4, 4))):
        if found[name].shape != shape:
            raise ValueError(f"camera {given.name!r}: {name} is {shape}, got the shape {found[name].shape}")
    return found
