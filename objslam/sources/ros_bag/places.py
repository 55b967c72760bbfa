"""The optical frames that tf knows, and their places on the robot."""

from dataclasses import dataclass

from objslam.core.arrays import Floats
from objslam.errors import LogError
from objslam.ros.tf.tree import TfTree


@dataclass(frozen=True)
class CameraPlace:
    """An optical frame in tf. chain: the frames from base to this frame. base_T_frame: (4, 4), None if the pose changes."""

    frame: str
    chain: tuple[str, ...]
    base_T_frame: Floats | None


def camera_places(tree: TfTree, base: str) -> tuple[CameraPlace, ...]:
    """Return the optical frames that tf connects to the frame `base`, sorted by name. The name of an optical frame ends in
    "optical" or "optical_frame"."""
    places = []
    for frame in sorted(frame for frame in tree.frames if frame.endswith(("optical_frame", "optical"))):
        try:
            places.append(CameraPlace(frame, tree.chain(base, frame), tree.still(base, frame)))
        except LogError:  # tf does not connect the frame to base. If a camera needs the frame, a run reports this.
            continue
    return tuple(places)
