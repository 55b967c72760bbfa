"""A drive around four things in the middle of a room, small enough to be run many times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.config import Odometry
from objslam.core.types import Detections, Log
from objslam.simulation import DriveSettings, PoseNoise, make_camera, simulate

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


def crowded(log: Log, frames: NDArray[np.int64], count: int, label: str = "leaf") -> Log:
    """The log with `count` more boxes of a label, anywhere in the image, in each of these frames of its first camera."""
    rng, first = np.random.default_rng(0), log.cameras[0]
    assert first.detections is not None
    names = (*first.detections.label_names, label)
    frame = np.repeat(frames, count)
    centre = rng.uniform(12, first.camera.size - 13, (len(frame), 2))
    more = Detections(
        frame_stamps=first.detections.frame_stamps,
        frame=frame,
        boxes=np.hstack([centre - 6, centre + 6]),
        label=np.full(len(frame), names.index(label)),
        scores=rng.uniform(0.3, 0.8, len(frame)),
        depths=np.full(len(frame), np.nan),
        track_ids=np.full(len(frame), -1),
        label_names=names,
    )
    order = np.argsort(np.concatenate([first.detections.frame, frame]), kind="stable")
    columns = ("frame", "boxes", "label", "scores", "depths", "track_ids")
    both = {name: np.concatenate([getattr(first.detections, name), getattr(more, name)])[order] for name in columns}
    return replace(log, cameras=(replace(first, detections=replace(more, **both)), *log.cameras[1:]))
