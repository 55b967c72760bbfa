"""A part of a recorded drive, and a drive whose landmarks have no names."""

from dataclasses import replace

import numpy as np

from objslam.core.types import Log, Trajectory


def part(log: Log, begin: float, end: float) -> Log:
    """The log between two times after its start, s."""
    (camera,), path = log.cameras, log.odometry
    assert path is not None
    assert camera.detections is not None

    def inside(stamps):
        return (stamps >= path.stamps[0] + begin) & (stamps <= path.stamps[0] + end)

    found, kept = camera.detections, inside(camera.detections.frame_stamps)
    number, rows = np.cumsum(kept) - 1, kept[found.frame]
    seen = replace(found.take(rows), frame_stamps=found.frame_stamps[kept], frame=number[found.frame[rows]])
    there = inside(path.stamps)
    odometry = Trajectory(path.stamps[there], path.poses[there])
    return replace(log, odometry=odometry, cameras=(replace(camera, detections=seen),))


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
