"""The camera class for users. It checks the calibration of each new camera. Its base class is in `core.camera`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.core import camera
from objslam.core.validity import camera_fault

_OUTSIDE = 10.0
"""The largest distance of a principal point from the image, as a multiple of the image size. If the image is a small part
cut out of another image, its principal point is outside by a few image sizes. With a larger multiple, more wrong numbers are
accepted."""


@dataclass(frozen=True)
class Camera(camera.Camera):
    """A calibrated camera with the fields of ROS camera_info, and its pose on the robot.

    Args:
        name: the name of the camera.
        width, height: the size of the image, px.
        matrix: (3, 3) the camera matrix, px. Its rows are fx 0 cx, 0 fy cy, 0 0 1.
        distortion_model: plumb_bob, rational_polynomial or equidistant.
        distortion: (D,) the coefficients of the model. The default is no distortion.
        base_T_camera: (4, 4) the pose of the optical frame (z ahead, x right, y down) in base, m.
        depth_scale: the units of a depth image per metre.
        sees_size: whether the boxes show how large the objects are.
        depth_noise: the noise of the camera's depths. None: the noise in the settings `depth`.
    Raises:
        ValueError: the calibration is not valid. The message names the fault.
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
    """Return the camera with a checked calibration. ValueError names the fault."""
    if isinstance(given, Camera):
        return given
    return Camera(**{name: getattr(given, name) for name in camera.Camera.__dataclass_fields__})


def checked_arrays(given: camera.Camera) -> dict[str, Any]:
    """Return the fields matrix, distortion and base_T_camera as arrays, by name. ValueError names a field of a wrong
    shape."""
    found = {name: np.asarray(getattr(given, name), dtype=np.float64) for name in ("matrix", "distortion", "base_T_camera")}
    for name, shape in (("matrix", (3, 3)), ("base_T_camera", (4, 4))):
        if found[name].shape != shape:
            raise ValueError(f"camera {given.name!r}: {name} is {shape}, got the shape {found[name].shape}")
    return found
