"""Which frames become keyframes."""

from __future__ import annotations

import math

import numpy as np

from objslam.config import Live
from objslam.types import Floats

_STANDING = 10  # keyframes from one place


class Pace:
    """A keyframe wherever a camera has moved or turned by as much as is set, and a few from where it stands."""

    def __init__(self, settings: Live) -> None:
        self._settings = settings
        self._last: dict[int, Floats] = {}
        self._shown: set[int] = set()
        self._standing = 0

    def skips(self, camera: int, start_T_camera: Floats, shown: set[int]) -> bool:
        """Whether a frame that a camera took there (4, 4), and that shows these labels, is between keyframes."""
        if self._moved(camera, start_T_camera):
            self._shown.clear()
            self._standing = 0
            return False
        return shown <= self._shown and self._standing >= _STANDING

    def keeps(self, camera: int, start_T_camera: Floats, shown: set[int]) -> None:
        """That frame became a keyframe."""
        self._last[camera] = start_T_camera
        self._shown |= shown
        self._standing += 1

    def _moved(self, camera: int, start_T_camera: Floats) -> bool:
        last = self._last.get(camera)
        if last is None:
            return True
        way = math.dist(last[:3, 3].tolist(), start_T_camera[:3, 3].tolist())
        cosine = (float(np.vdot(last[:3, :3], start_T_camera[:3, :3])) - 1) / 2
        turned = math.acos(min(1.0, max(-1.0, cosine)))
        return way >= self._settings.keyframe_distance or turned >= math.radians(self._settings.keyframe_angle_deg)
