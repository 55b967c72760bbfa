"""The boxes of one image before they are pushed, and the depth images that give their depths."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.frontend.box_depths import MAX_IMAGE_LAG, box_depth
from objslam.ros.bag.records import frame_name
from objslam.ros.messages.decode import DecodeError
from objslam.ros.messages.images import DEPTH_SCALE, depth_image

_KEPT = 30  # The depth images kept per camera: 1 s at 30 Hz, the delay of a detector. A larger number costs memory.
_MAX_FRAMES = 16  # The most coordinate frames with depth images. A larger number costs memory.
Drop = Callable[[str, str], None]  # A function that counts a drop. Its arguments are the reason and the place.


@dataclass
class Boxes:
    """The boxes of one image.

    stamp: s. frame: the camera's tf frame, or "" if unknown. arrived: the time of arrival, s, by the caller's clock. boxes:
    (B, 4), raw px. points: the centre and corners (5, 3) of a tag, m, in the camera frame, by the index of the box that they
    give. size: (width, height) of the image, px, or None if unknown. whole: True if no box is cut off at the image's edge.
    image: (H, W, 3) uint8 BGR, or None if not available.
    """

    topic: str
    stamp: float
    frame: str
    arrived: float
    boxes: Floats
    labels: Sequence[str]
    scores: Floats
    track_ids: Sequence[int] | None = None
    points: dict[int, Floats] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    whole: bool = False
    image: NDArray[np.uint8] | None = None

    @property
    def place(self) -> str:
        """The name of the image in reports: its topic and its stamp."""
        return f"{self.topic} at {self.stamp:.3f} s"


class DepthImages:
    """Keeps depth image messages, and decodes a message only when boxes need it."""

    def __init__(self, drop: Drop) -> None:
        self._drop = drop
        self._kept: dict[str, deque[tuple[float, str, Any]]] = {}

    def add(self, topic: str, message: Any, stamp: float) -> None:
        """Keep a depth image, which must be registered to the camera whose tf frame it names. stamp: s."""
        frame = frame_name(message.header.frame_id)
        if frame not in self._kept and len(self._kept) >= _MAX_FRAMES:
            self._drop(f"depth image beyond the first {_MAX_FRAMES} frames", topic)
            return
        self._kept.setdefault(frame, deque(maxlen=_KEPT)).append((stamp, topic, message))

    def awaits(self, boxes: Boxes) -> bool:
        """Return whether the depth image of the boxes may still arrive, because all depth images so far are older."""
        kept = self._kept.get(boxes.frame)
        return kept is not None and kept[-1][0] < boxes.stamp - MAX_IMAGE_LAG

    def at(self, boxes: Boxes, camera: Camera) -> Floats | None:
        """Return the depths (B,) of boxes, m, NaN where unknown. Return None if their camera has no depth images."""
        kept = self._kept.get(boxes.frame)
        if not kept:
            return None
        depths = np.full(len(boxes.boxes), np.nan)
        stamp, topic, message = min(kept, key=lambda entry: abs(entry[0] - boxes.stamp))
        place = f"{topic} at {stamp:.3f} s"
        if abs(stamp - boxes.stamp) > MAX_IMAGE_LAG:
            self._drop("depth of a frame without a depth image", boxes.place)
            return depths
        try:
            image = depth_image(message)
        except DecodeError as error:
            self._drop("depth image that cannot be decoded", f"{place}: {error}")
            return depths
        if image.shape != (camera.height, camera.width):
            self._drop("depth image that does not have the camera's size", place)
            return depths
        focal = float(camera.matrix[0, 0])
        for index in np.flatnonzero(np.isfinite(boxes.boxes).all(axis=1)).tolist():
            depths[index] = box_depth(image, boxes.boxes[index], focal) / DEPTH_SCALE
        return depths
