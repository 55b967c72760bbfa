"""The state of a live session at one moment."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory

NOT_USED = " not used"  # The end of a name in `Snapshot.counters`, such as "odometry not used" if the settings exclude it.
CAME_BEFORE = " that came before"  # The end of a name in `Snapshot.counters`, for repeated data of a restarted program.
LATE_FRAME = "frame that is late (live.max_late)"  # The reason to drop a frame whose poses are long past.
TOO_SLOW = "frames that waited too long (live.max_lag)"  # The reason to drop a frame for which the session had no time.
RARE_POSES = "frames whose pose came more than live.max_lag later: poses are too rare or late, or live.max_lag is too short"


@dataclass(frozen=True)
class CameraFrame:
    """The boxes of one camera at one keyframe.

    stamp: s. map_T_camera: (4, 4). boxes: (B, 4) raw px. objects: (B,) the id of the object in each box, or -1. rejected:
    (B,) whether the robust loss rejected the box. image: (H, W, 3) uint8 BGR, or the bytes of a JPEG file, or None.
    """

    stamp: float
    camera: Camera
    map_T_camera: Floats
    boxes: Floats
    objects: Ints
    rejected: Bools
    image: NDArray[np.uint8] | bytes | None = None


@dataclass(frozen=True)
class InPriorMap:
    """The place of a session in a prior map.

    objects: the number of objects of the prior map that the session found again, 0 while the place is unknown. line: a
    sentence for the user, with this number and the evidence, or with the reason why the place is unknown.
    """

    objects: int
    line: str


@dataclass(frozen=True)
class Snapshot:
    """The state of a session at one moment.

    stamp: the time of the newest keyframe, s, NaN before the first keyframe. map: the objects, as an offline run returns
    them. path: map_T_base of all keyframes. keyframes, rebuilds: the number of keyframes, and how often the graph was
    rebuilt. lag: the time, s, from the arrival of the newest frame in the map until the map contained this frame. update:
    the median and the 99th percentile of the lag of recent frames, s. counters: how many messages of each kind were
    accepted. dropped: how many data were dropped, by reason. frames: the newest keyframe of each camera, without its image.
    calibration: the shared errors that the session corrects in its measurements, None if it corrects none. map_T_odom: (4,
    4) the pose of the odometry's frame in the map at the newest keyframe (REP 105). It holds for odometry as the robot sends
    it, without corrections. None if the odometry does not cover this keyframe. in_map: the place in a prior map, None
    without such a map or before the first search for it. Once the place is known, everything is in the frame of the prior
    map.
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
    calibration: Calibration | None = None
    map_T_odom: Floats | None = None
    in_map: InPriorMap | None = None
