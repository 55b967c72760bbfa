"""Cut a part out of a log by time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Images, Log, Truth
from objslam.errors import LogError


def part_of_log(log: Log, begin: float | None, end: float | None) -> Log:
    """Return the part of a log from the stamp `begin`, s, up to the stamp `end`, s, which is outside. None means no limit.

    The poses, images and boxes outside are left out. The objects of the truth stay. LogError if no pose, no
    pose of a moving camera, or no detection frame is inside.
    """
    low, high = -np.inf if begin is None else begin, np.inf if end is None else end

    def inside(stamps: Floats) -> Bools:
        return np.asarray((stamps >= low) & (stamps < high))

    def path(whole: Trajectory | None) -> Trajectory | None:
        if whole is None:
            return None
        there = inside(whole.stamps)
        travel = None if whole.travel is None else whole.travel[there]
        return replace(whole, stamps=whole.stamps[there], poses=whole.poses[there], travel=travel) if there.any() else None

    def images(whole: Images | None) -> Images | None:
        if whole is None:
            return None
        there = np.flatnonzero(inside(whole.stamps))
        return Images(whole.stamps[there], tuple(whole.paths[i] for i in there.tolist()))

    def boxes(whole: Detections | None) -> Detections | None:
        if whole is None:
            return None
        there = inside(whole.frame_stamps)
        number, rows = np.cumsum(there) - 1, there[whole.frame]
        found = whole.take(rows)
        # Both fields change at once, because the boxes must fit the frames.
        return replace(found, frame_stamps=whole.frame_stamps[there], frame=number[whole.frame[rows]])

    def camera(whole: CameraLog) -> CameraLog:
        return replace(
            whole,
            detections=boxes(whole.detections),
            rgb=images(whole.rgb),
            depth=images(whole.depth),
            mount=path(whole.mount),
        )

    truth = log.truth if log.truth is None else Truth(log.truth.objects, path(log.truth.trajectory))
    found = replace(
        log,
        odometry=path(log.odometry),
        localization=path(log.localization),
        cameras=tuple(camera(one) for one in log.cameras),
        truth=truth,
        part=(begin, end),
    )
    if found.robot_path is None and log.robot_path is not None:
        raise _outside("pose", log, log.robot_path.stamps)
    for one, whole in zip(found.cameras, log.cameras, strict=True):
        if whole.mount is not None and one.mount is None:  # Without poses, the camera would look like a fixed camera.
            raise _outside(f"pose of the camera {whole.camera.name}", log, whole.mount.stamps)
    stamps = [one.detections.frame_stamps for one in log.cameras if one.detections is not None]
    left = [one.detections.frame_stamps for one in found.cameras if one.detections is not None]
    if any(len(some) for some in stamps) and not any(len(some) for some in left):
        raise _outside("detection frame", log, np.sort(np.concatenate(stamps)))
    return found


def part_in_words(part: tuple[float | None, float | None]) -> str:
    """Return the limits of a part of a log in words, such as "from stamp 10.000 to 20.000 s". The text is empty for a whole
    log."""
    begin, end = part
    limits = ([] if begin is None else [f"from stamp {begin:.3f}"]) + ([] if end is None else [f"to stamp {end:.3f}"])
    return " ".join(limits).replace(" to stamp", " to") + " s" if limits else ""


def _outside(what: str, log: Log, stamps: Floats) -> LogError:
    return LogError(
        f"no {what} lies in the asked part of the log; their stamps are from {stamps[0]:.3f} to {stamps[-1]:.3f} s",
        where=log.name,
        hint="change --begin or --end",
    )
