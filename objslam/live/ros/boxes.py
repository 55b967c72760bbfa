"""The boxes of one image before they are pushed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats

Drop = Callable[[str, str], None]
"""A function that counts a drop, given its reason and its place."""


@dataclass
class Boxes:
    """The boxes of one image.

    stamp: s. frame: the camera's tf frame, "" if unknown. arrived: s, any clock. points: by the index of a box, the tag that
    replaces the box, (5, 3) m in the camera frame. size: (width, height) of the image, px, None if unknown. whole: as in
    `types.Detections`. image: (H, W, 3) uint8 BGR, None if not available.
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
        """The topic and the stamp, as reports name the image."""
        return f"{self.topic} at {self.stamp:.3f} s"
