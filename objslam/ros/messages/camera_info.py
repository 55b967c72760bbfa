"""Convert CameraInfo messages to cameras."""

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import COEFFICIENTS, Camera, DistortionModel
from objslam.core.geometry import make_pose
from objslam.core.validity import MAX_DISTORTION, camera_fault, rigid_pose
from objslam.errors import LogError

_MODELS = {
    "fisheye": "equidistant",
    "radtan": "plumb_bob",
    "plumb bob": "plumb_bob",
    "rational polynomial": "rational_polynomial",
}  # The distortion models by the alternative names that drivers use.
_UNDISTORTED = ("", "none", "plumb_bob", "rational_polynomial", "equidistant")
"""The names of the models that have no distortion if D is zero."""
_HINT = "--camera-info FILE can give the calibration"


def camera_of(info: Any, name: str, topic: str, rectified: bool) -> tuple[Camera, Floats]:
    """Return the camera of a sensor_msgs/CameraInfo (ROS 1 or 2), and its pose frame_T_camera (4, 4) in the header frame.

    rectified: whether the images are rectified. If True, the camera has no distortion, its matrix is the left 3x3 part of P
    (K if both P and D are zero), and frame_T_camera is the identity. If False, K is the matrix, D is the distortion, and R
    is the rotation of frame_T_camera. The header frame belongs to the rectified camera, as in image_geometry. The camera
    describes images after binning and region of interest. name: the name of the camera. topic: the topic of the message,
    for errors. Raises LogError if the camera is not calibrated or its distortion is invalid.
    """
    values = _values(info, "P")[[0, 1, 2, 4, 5, 6, 8, 9, 10]] if rectified else _values(info, "K")
    if rectified and not values.any() and not _values(info, "D").any():  # P is unset. K is the same without distortion.
        values = _values(info, "K")
    across, down = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    region = info.roi  # K and P describe the full image, before region of interest and binning.
    width, height = int(region.width or info.width) // across, int(region.height or info.height) // down
    matrix = values.reshape(3, 3).copy()
    matrix[0, 2] -= region.x_offset
    matrix[1, 2] -= region.y_offset
    matrix[0] /= across
    matrix[1] /= down
    matrix[0, 1] = matrix[1, 0] = matrix[2, 0] = matrix[2, 1] = 0.0
    matrix[2, 2] = 1.0
    camera = Camera(name, width, height, matrix)
    if camera_fault(camera) is not None:
        which = "P" if rectified else "K"
        what = f"the camera is not calibrated ({which} or the size of the image is zero or too large)"
        raise LogError(what, where=topic, hint=_HINT)
    if rectified:
        return camera, np.eye(4)
    model, distortion = _distortion(info, topic)
    turn = rigid_pose(make_pose(_values(info, "R").reshape(3, 3), np.zeros(3)))
    return replace(camera, distortion_model=model, distortion=distortion), np.eye(4) if turn is None else turn


def camera_names(frames: Iterable[str]) -> list[str]:
    """Return a unique camera name for each coordinate frame. The names are valid as file names."""
    names: list[str] = []
    for frame in frames:
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", frame.removesuffix("_optical_frame"))[:60].strip("_-") or "camera"
        names.append(plain if plain not in names else f"{plain}_{len(names)}")
    return names


def _values(info: Any, name: str) -> Floats:
    return np.array(getattr(info, name if hasattr(info, name) else name.lower()), dtype=np.float64)


def _distortion(info: Any, topic: str) -> tuple[DistortionModel, Floats]:
    values = _values(info, "D")
    if not (np.abs(values) < MAX_DISTORTION).all():
        raise LogError("its distortion is not finite or too large", where=topic)
    given = str(info.distortion_model)
    name = _MODELS.get(given.lower().replace("-", " ").strip(), given)
    if not values.any() and name in _UNDISTORTED:
        return "plumb_bob", np.zeros(5)
    model = next((known for known in get_args(DistortionModel) if known == name), None)
    if model is None:
        raise LogError(f"unknown distortion_model {given[:40]!r}, known: {', '.join(COEFFICIENTS)}", where=topic, hint=_HINT)
    if len(values) not in COEFFICIENTS[model]:
        counts = " or ".join(map(str, COEFFICIENTS[model]))
        raise LogError(f"{model} takes {counts} coefficients, got {len(values)}", where=topic, hint=_HINT)
    return model, values
