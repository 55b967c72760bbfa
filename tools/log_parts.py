"""A part of a recorded drive, and a drive whose landmarks have no names."""

from dataclasses import replace

import numpy as np

from objslam.core.types import Log
from objslam.frontend.log_part import part_of_log


def part(log: Log, begin: float, end: float) -> Log:
    """The log between two times after its start, s."""
    assert log.robot_path is not None
    start = log.robot_path.stamps[0]
    return part_of_log(log, start + begin, start + end)


def without_names(log: Log) -> Log:
    """The log, and its truth if it has one, with one label for all landmarks."""
    cameras = tuple(
        replace(c, detections=replace(c.detections, label=np.zeros_like(c.detections.label), label_names=("landmark",)))
        for c in log.cameras
        if c.detections is not None
    )
    if log.truth is None:
        return replace(log, cameras=cameras)
    objects = tuple(replace(one, label="landmark") for one in log.truth.objects)
    return replace(log, cameras=cameras, truth=replace(log.truth, objects=objects))
