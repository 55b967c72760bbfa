"""The boxes of one image on their way to a session, and how what is dropped on it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats

Drop = Callable[[str, str], None]
"""Called with the reason why something was dropped, and where."""


@dataclass
class Boxes:
    """The boxes of one image: stamp, s; frame: the camera's, as tf names it, "" where unknown; arrived: s, any clock.

    points: by the index of its box, a tag that comes without a box (see boxes2d). size: of the image, where known.
    whole: as `types.Detections` has it. image: (H, W, 3) uint8 BGR, where it was at hand.
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
        return f"{self.topic} at {self.stamp:.3f} s"
