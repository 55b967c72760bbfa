"""The latest depth images of each camera, for the depths of its boxes."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.frontend.box_depths import MAX_IMAGE_LAG, box_depth
from objslam.live.ros.boxes import Boxes, Drop
from objslam.ros.bag.records import frame_name
from objslam.ros.messages.decode import DecodeError
from objslam.ros.messages.images import DEPTH_SCALE, depth_image

_KEPT = 30  # The messages of a frame that are kept; chosen for 1 s at 30 Hz, which a detector may take.
_MAX_FRAMES = 16  # The most frames whose depth images are kept; chosen to bound the memory.


class DepthImages:
    """Keeps messages; one is decoded when boxes ask for it."""

    def __init__(self, drop: Drop) -> None:
        self._drop = drop
        self._kept: dict[str, deque[tuple[float, str, Any]]] = {}

    def add(self, topic: str, message: Any, stamp: float) -> None:
        """Keep a depth image message; stamp: s."""
        frame = frame_name(message.header.frame_id)
        if frame not in self._kept and len(self._kept) >= _MAX_FRAMES:
            self._drop(f"depth image beyond the first {_MAX_FRAMES} frames", topic)
            return
        self._kept.setdefault(frame, deque(maxlen=_KEPT)).append((stamp, topic, message))

    def awaits(self, boxes: Boxes) -> bool:
        """Whether the depth image of that moment may still be on its way: all that have come are older."""
        kept = self._kept.get(boxes.frame)
        return kept is not None and kept[-1][0] < boxes.stamp - MAX_IMAGE_LAG

    def at(self, boxes: Boxes, camera: Camera) -> Floats | None:
        """Depths (B,) of boxes, m, NaN where unknown; None where their camera has no depth images."""
        kept = self._kept.get(boxes.frame)
        if not kept:
            return None
        depths = np.full(len(boxes.boxes), np.nan)
        stamp, topic, message = min(kept, key=lambda entry: abs(entry[0] - boxes.stamp))
        if abs(stamp - boxes.stamp) > MAX_IMAGE_LAG:
            self._drop("depth of a frame without a depth image", boxes.place)
            return depths
        image = self._decode(message, camera, f"{topic} at {stamp:.3f} s")
        if image is not None:
            for index in np.flatnonzero(np.isfinite(boxes.boxes).all(axis=1)).tolist():
                depths[index] = box_depth(image, boxes.boxes[index]) / DEPTH_SCALE
        return depths

    def _decode(self, message: Any, camera: Camera, place: str) -> NDArray[Any] | None:
        try:
            image = depth_image(message)
        except DecodeError as error:
            self._drop("depth image that cannot be decoded", f"{place}: {error}")
            return None
        if image.shape != (camera.height, camera.width):
            self._drop("depth image that has not the camera's size", place)
            return None
        return image
