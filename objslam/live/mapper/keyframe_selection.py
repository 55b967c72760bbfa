"""Which frames become keyframes."""

from __future__ import annotations

import math

import numpy as np

from objslam.config import Live
from objslam.core.arrays import Floats

_STANDING = 10
"""Keyframes from one place; more average the detector's noise, and cost time while the robot stands."""


class KeyframeSelector:
    """A keyframe wherever a camera has moved or turned by as much as is set, and a few from where it stands."""

    def __init__(self, settings: Live) -> None:
        self._settings = settings
        self._last: dict[int, Floats] = {}
        self._shown: set[int] = set()
        self._standing = 0

    def is_redundant(self, camera: int, start_T_camera: Floats, shown: set[int]) -> bool:
        """Whether keyframes from the same place show as much as a frame with these labels, taken at (4, 4) on the course."""
        seen_before = shown <= self._shown and self._standing >= _STANDING
        return seen_before and not self._has_moved(camera, start_T_camera)

    def accept(self, camera: int, start_T_camera: Floats, shown: set[int]) -> None:
        """A frame became a keyframe."""
        self.pass_over(camera, start_T_camera)
        self._last[camera] = start_T_camera
        self._shown |= shown
        self._standing += 1

    def pass_over(self, camera: int, start_T_camera: Floats) -> None:
        """A frame is not redundant, but no keyframe either: another place begins where its camera has moved."""
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
