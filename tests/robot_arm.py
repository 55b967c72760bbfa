"""Boxes that a detector gives to the robot's own arm."""

import numpy as np
from more_boxes import with_boxes

from objslam.core.types import Log

ARM = np.array([210.0, 330.0, 290.0, 400.0])


def with_arm(log: Log, label: str, share: float = 0.5) -> Log:
    """The log with boxes of the robot's arm, in this share of the frames, with 1.5 px of noise."""
    rng = np.random.default_rng(1)
    found = log.cameras[0].detections
    assert found is not None
    frames = np.flatnonzero(rng.random(len(found.frame_stamps)) < share)
    return with_boxes(log, frames, ARM + rng.normal(0, 1.5, (len(frames), 4)), label)
