"""The state of a live session at one moment."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.types import Trajectory


@dataclass(frozen=True)
class CameraFrame:
    """The boxes of one camera at one keyframe.

    stamp: s. map_T_camera: (4, 4). boxes: (B, 4) raw px. objects: (B,) the id of each box's object, or -1. rejected: (B,)
    whether the robust loss rejected the box. image: (H, W, 3) uint8 BGR or JPEG bytes, None without an image.
    """

    stamp: float
    camera: Camera
    map_T_camera: Floats
    boxes: Floats
    objects: Ints
    rejected: Bools
    image: NDArray[np.uint8] | bytes | None = None


@dataclass(frozen=True)
class Snapshot:
    """The state of a session at one moment.

    stamp: of the newest keyframe, s, NaN before the first keyframe. map: the objects, as an offline run returns them. path:
    map_T_base of all keyframes. keyframes, rebuilds: the number of keyframes, and of rebuilds of the graph. lag: s from the
    arrival of the newest message to its place in the map. update: median and 99th percentile of the time from push to
    updated map, s. counters: accepted messages by kind. dropped: drops by reason. frames: the newest keyframe of each
    camera, without its image.
    """

    stamp: float
    map: ObjectMap
    path: Trajectory
    keyframes: int = 0
    rebuilds: int = 0
    lag: float = 0.0
    update: tuple[float, float] = (0.0, 0.0)
    counters: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    frames: tuple[CameraFrame, ...] = ()
