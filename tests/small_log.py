"""A drive around four things in the middle of a room, small enough to be run many times."""

from __future__ import annotations

from typing import Any

import numpy as np

from objslam.config import Odometry
from objslam.simulation import DriveSettings, PoseNoise, make_camera, simulate
from objslam.types import Log

THINGS = (
    ("cup", (1.0, 0.5, 0.5)),
    ("tall chair", (-0.8, 0.6, 0.6)),
    ("Bücherregal", (0.2, -1.0, 0.8)),
    ("plant", (-0.6, -0.5, 0.4)),
)


def small_log(seed: int = 0, **changes: Any) -> Log:
    """80 frames of a camera that looks left, to the middle; with odometry and localisation. changes: of DriveSettings."""
    drive: dict[str, Any] = {
        "name": "small",
        "room": (7.0, 7.0),
        "path": (1, 1),
        "laps": 1.0,
        "objects": 0,
        "placed": THINGS,
        "cameras": (make_camera("left", focal=380.0, position=(0.0, 0.0, 0.3), yaw=np.pi / 2),),
        "frames": 80,
        "pixel_sigma": 2.0,
        "missed": 0.1,
        "false": 0.02,
        "odometry": Odometry(),
        "localization": PoseNoise(xy=0.02, yaw=0.005),
    }
    return simulate(DriveSettings(**{**drive, **changes}), seed)
