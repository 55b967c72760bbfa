"""The boxes of bodies of which the image shows only a part."""

from dataclasses import dataclass, fields, replace
from typing import Self

from objslam.core.arrays import Floats, Ints


@dataclass(frozen=True)
class CutBoxes:
    """The boxes that the image's edge cuts off. Their centres are wrong, so they give no rays, but bodies use their edges.

    camera: (C,) index into log.cameras. frame: (C,) index into detections.frame_stamps of this camera. label: (C,) index
    into label_names of the rays. box: (C, 4) raw px.
    """

    camera: Ints
    frame: Ints
    label: Ints
    box: Floats

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, index: Ints) -> Self:
        """Return the boxes with the indices (n,)."""
        return replace(self, **{one.name: getattr(self, one.name)[index] for one in fields(self)})
