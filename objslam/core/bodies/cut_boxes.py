"""The boxes of bodies that the image shows only a part of."""

from dataclasses import dataclass

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
