"""Describe a camera's calibration in words, so that a wrong calibration is seen at a glance."""

import numpy as np

from objslam.core.camera import Camera, spoken_name, undistort

_SECTORS = ("ahead", "ahead and left", "left", "behind and left", "behind", "behind and right", "right", "ahead and right")
_STEEP = 60.0  # The least elevation, degrees, of a camera that "looks up" or "looks down". With a larger value, fewer do.
_LEVEL = 5.0  # The largest elevation or tilt, degrees, that the text omits. A larger value omits more angles.
_ASPECT = 1.2  # The largest fx / fy or fy / fx without a doubt. Real lenses are below 1.1. A larger value: fewer doubts.


def view_of(camera: Camera) -> str:
    """Return a text on a camera's direction, tilt, height and angle of view.

    An example is "looks ahead, 0.30 m above base, 70 degrees wide".
    """
    right, down, forward = camera.base_T_camera[:3, :3].T
    height = float(camera.base_T_camera[2, 3])
    parts = [] if _has_no_rotation(camera) else [f"looks {_direction(forward)}"]
    tilt = float(np.degrees(np.arcsin(np.clip(right[2], -1, 1))))
    if abs(forward[2]) < np.sin(np.radians(_STEEP)):
        if down[2] > np.sin(np.radians(45)):
            parts.append("upside down")
        elif abs(tilt) > _LEVEL:
            parts.append(f"tilted by {abs(tilt):.0f} degrees")
    parts.append(f"{abs(height):.2f} m {'above' if height >= 0 else 'below'} base")
    return ", ".join([*parts, f"{_width(camera):.0f} degrees wide"])


def doubts_of(camera: Camera) -> list[str]:
    """Return a line for each unusual property of a camera's calibration."""
    doubts = []
    if _has_no_rotation(camera):
        doubts.append(
            f"{spoken_name(camera.name)}: base_T_camera has no rotation. That is right if the poses are poses of the "
            "camera's optical frame (z forward). On a robot, a camera that looks ahead has "
            "rotation_xyzw [-0.5, 0.5, -0.5, 0.5]"
        )
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    if max(fx, fy) > _ASPECT * min(fx, fy):
        doubts.append(f"{spoken_name(camera.name)}: fx {fx:g} px and fy {fy:g} px differ, although pixels are nearly square")
    return doubts


def _has_no_rotation(camera: Camera) -> bool:
    """Return whether base_T_camera has no rotation. On a robot, this means that nobody has set the rotation. The direction
    of the camera is then unknown."""
    return np.allclose(camera.base_T_camera[:3, :3], np.eye(3), atol=1e-6)


def _direction(forward: np.ndarray) -> str:
    """Return the direction of the unit vector `forward` (3,), in base, in words."""
    up = float(np.degrees(np.arcsin(np.clip(forward[2], -1, 1))))
    if abs(up) >= _STEEP:
        return "up" if up > 0 else "down"
    sector = _SECTORS[round(np.degrees(np.arctan2(forward[1], forward[0])) / 45) % len(_SECTORS)]
    return sector if abs(up) <= _LEVEL else f"{sector}, {abs(up):.0f} degrees {'up' if up > 0 else 'down'}"


def _width(camera: Camera) -> float:
    """Return the angle, degrees, between the left and the right edge of the image, in the row of the principal point."""
    row = camera.matrix[1, 2]
    edges, valid = undistort(camera, np.array([[-0.5, row], [camera.width - 0.5, row]]))
    if not valid.all():  # The lens model has no inverse at an edge, so its distortion is left out.
        edges = np.linalg.solve(camera.matrix, np.array([[-0.5, camera.width - 0.5], [row, row], [1, 1]])).T
    angles = np.arctan2(edges[:, 0], edges[:, 2])
    return float(np.degrees(angles[1] - angles[0]))
