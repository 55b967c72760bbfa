"""The selection of keyframes by motion and by new labels."""

import math

import numpy as np

from objslam.config import Live
from objslam.core.arrays import Floats

_STANDING = 10  # The most keyframes of one stop, without new labels. More of them average the noise, and cost time.


class KeyframeSelector:
    """Selects a keyframe when a camera has moved by a set distance or angle, and a few keyframes while the cameras stand.

    The methods share their arguments. camera: the number of the camera. start_T_camera: (4, 4) the camera's pose on the
    course. shown: the numbers of the labels in the frame.
    """

    def __init__(self, settings: Live) -> None:
        self._settings = settings
        self._last: dict[int, Floats] = {}
        self._shown: set[int] = set()
        self._standing = 0

    def is_redundant(self, camera: int, start_T_camera: Floats, shown: set[int]) -> bool:
        """Return whether a frame adds nothing: its camera stands, and enough keyframes since the camera stopped show its
        labels."""
        seen_before = shown <= self._shown and self._standing >= _STANDING
        return seen_before and not self._has_moved(camera, start_T_camera)

    def accept(self, camera: int, start_T_camera: Floats, shown: set[int]) -> None:
        """Register a frame that became a keyframe."""
        self.pass_over(camera, start_T_camera)
        self._last[camera] = start_T_camera
        self._shown |= shown
        self._standing += 1

    def place(self, camera: int, start_T_camera: Floats) -> None:
        """Change the pose of a camera's last keyframe, after the course has changed."""
        self._last[camera] = start_T_camera

    def pass_over(self, camera: int, start_T_camera: Floats) -> None:
        """Register a frame that is neither redundant nor a keyframe. If the camera has moved since its last keyframe, the
        camera no longer counts as standing."""
        if self._has_moved(camera, start_T_camera):
            self._shown.clear()
            self._standing = 0

    def _has_moved(self, camera: int, start_T_camera: Floats) -> bool:
        last = self._last.get(camera)
        if last is None:
            return True
        way = math.dist(last[:3, 3].tolist(), start_T_camera[:3, 3].tolist())
        cosine = (float(np.vdot(last[:3, :3], start_T_camera[:3, :3])) - 1) / 2
        turned = math.acos(min(1.0, max(-1.0, cosine)))
        return way >= self._settings.keyframe_distance or turned >= math.radians(self._settings.keyframe_angle_deg)
