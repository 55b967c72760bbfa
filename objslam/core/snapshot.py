"""The state of a live session at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.types import Trajectory


@dataclass(frozen=True)
class CameraFrame:
    """What a camera saw at one keyframe.

    stamp: s. map_T_camera: (4, 4). boxes: (B, 4) raw px. objects: (B,) ids, -1 where none explains a box. rejected: (B,)
    whether the robust loss rejected it. image: (H, W, 3) uint8 BGR or JPEG, as the camera has it; None without.
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

    stamp: of the newest keyframe, s (NaN before the first). map: the objects, as offline gives them. path: map_T_base of all
    keyframes. lag: s between a message's arrival and its place in the map, the newest. update: (p50, p99) s from push to
    updated. counters: accepted messages by kind; dropped: by reason. keyframes, rebuilds: how many.
    frames: the newest keyframe of each camera, without its image, which no session sees.
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
