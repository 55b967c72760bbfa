"""CameraInfo messages as cameras."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, get_args

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import COEFFICIENTS, Camera, DistortionModel
from objslam.core.geometry import make_pose
from objslam.errors import LogError

_MODELS = {
    "fisheye": "equidistant",
    "radtan": "plumb_bob",
    "plumb bob": "plumb_bob",
    "rational polynomial": "rational_polynomial",
}
"""The distortion models by other spellings, which drivers use."""

_UNDISTORTED = ("", "none", "plumb_bob", "rational_polynomial", "equidistant")
"""The models that distort nothing where all coefficients are zero."""

_MAX_PIXELS = 1 << 16  # The longest side of an image, px; above it a calibration is taken for damaged.
_MAX_FOCAL = 1e7  # The largest number of a camera matrix, px; above it a calibration is taken for damaged.
_HINT = "--camera-info FILE can stand in for it"


def camera_of(info: Any, name: str, topic: str, rectified: bool) -> tuple[Camera, Floats]:
    """The camera that a sensor_msgs/CameraInfo of ROS 1 or 2 describes, and its frame in that of the header, (4, 4).

    rectified: for images that are undistorted already: the left 3x3 part of P, no distortion. Else K and D, and the frame of
    the raw image is turned against that of the header, which is the rectified one, by R (as image_geometry has it).
    Binning and a region of interest are applied. LogError where the camera is not calibrated or the model not known.
    """
    values = _values(info, "P")[[0, 1, 2, 4, 5, 6, 8, 9, 10]] if rectified else _values(info, "K")
    if rectified and not values.any() and not _values(info, "D").any():  # nothing to rectify, and nobody filled in P
        values = _values(info, "K")
    width, height, matrix = _image(info, values)
    sane = bool((np.abs(matrix) < _MAX_FOCAL).all()) and matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not (sane and 0 < width < _MAX_PIXELS > height > 0):
        which = "P" if rectified else "K"
        raise LogError(f"the camera is not calibrated ({which} or the size of the image is zero)", where=topic, hint=_HINT)
    matrix[0, 1] = matrix[1, 0] = matrix[2, 0] = matrix[2, 1] = 0.0
    matrix[2, 2] = 1.0
    if rectified:
        return Camera(name, width, height, matrix), np.eye(4)
    model, distortion = _distortion(info, topic)
    rotation = _values(info, "R").reshape(3, 3)
    turned = bool((np.abs(rotation) < 1.01).all())
    turned = turned and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0
    frame_T_camera = make_pose(rotation if turned else np.eye(3), np.zeros(3))
    return Camera(name, width, height, matrix, model, distortion), frame_T_camera


def camera_names(frames: Iterable[str]) -> list[str]:
    """A name that can be a file name for each frame, all different."""
    names: list[str] = []
    for frame in frames:
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", frame.removesuffix("_optical_frame"))[:60].strip("_-") or "camera"
        names.append(plain if plain not in names else f"{plain}_{len(names)}")
    return names


def _values(info: Any, name: str) -> Floats:
    return np.array(getattr(info, name if hasattr(info, name) else name.lower()), dtype=np.float64)


def _image(info: Any, values: Floats) -> tuple[int, int, Floats]:
    """Size and matrix of the image as it was sent: K and P are of the full one, before the region was cut and binned."""
    across, down = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    region = info.roi
    width, height = int(region.width or info.width) // across, int(region.height or info.height) // down
    matrix = values.reshape(3, 3).copy()
    matrix[0, 2] -= region.x_offset
    matrix[1, 2] -= region.y_offset
    matrix[0] /= across
    matrix[1] /= down
    return width, height, matrix


def _distortion(info: Any, topic: str) -> tuple[DistortionModel, Floats]:
    values = _values(info, "D")
    if not np.isfinite(values).all():
        raise LogError("its distortion is not finite", where=topic)
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
