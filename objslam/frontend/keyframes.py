"""Keyframes: camera frames with a pose, read from the robot's path at their stamps."""

from __future__ import annotations

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse
from objslam.core.types import CameraLog, Keyframes, Log, Trajectory
from objslam.errors import LogError
from objslam.frontend.odometry_drift import gathered_drift


def build_keyframes(log: Log, settings: Settings, ledger: Ledger) -> Keyframes:
    """The frames of all cameras that lie on the robot's path, in the order of time.

    The path is the localisation where there is one, else the odometry. In joint mode a frame must also lie on the odometry
    if there is one, for the motion between keyframes. Frames outside a path, or in a gap longer than poses.max_gap, are
    dropped and counted with their boxes; nothing is extrapolated.

    Raises:
        LogError: when there is no path, no detection frame, or no frame on the path.
    """
    path = log.localization or log.odometry
    if path is None:
        raise LogError("the log has neither odometry nor localisation", where=log.name)
    odometry = log.odometry if settings.mode == "joint" else None
    max_gap = settings.poses.max_gap

    counts = [0 if c.detections is None else len(c.detections.frame_stamps) for c in log.cameras]
    if not sum(counts):
        raise LogError("there are no detection frames", where=log.name, hint="give detections.jsonl or a detector")
    camera = np.repeat(np.arange(len(counts)), counts)
    frame = np.concatenate([np.arange(n) for n in counts])
    stamps = np.concatenate([c.detections.frame_stamps for c in log.cameras if c.detections is not None])
    boxes = np.concatenate([_boxes_per_frame(c) for c in log.cameras])
    order = np.lexsort((camera, stamps))
    camera, frame, stamps, boxes = camera[order], frame[order], stamps[order], boxes[order]

    valid = np.ones(len(stamps), dtype=bool)
    what = "localisation" if log.localization else "odometry"
    map_T_base, on_path = _on_path(path, stamps, valid, boxes, max_gap, ledger, what)
    valid &= on_path
    odom_T_base, drift, stretch = None, None, None
    if odometry is not None:
        odom_T_base, drift = map_T_base, gathered_drift(odometry, stamps, settings.odometry)
        if log.localization is not None:
            odom_T_base, on_odometry = _on_path(odometry, stamps, valid, boxes, max_gap, ledger, "odometry")
            valid &= on_odometry
        odom_T_base = inverse(odometry.poses[0]) @ odom_T_base
        stretch = _stretches(odometry, stamps, max_gap)
    base_T_camera = np.empty((len(stamps), 4, 4))
    for index, camera_log in enumerate(log.cameras):
        mine = camera == index
        base_T_camera[mine] = camera_log.camera.base_T_camera
        if camera_log.mount is not None:
            what = f"camera_poses of {camera_log.camera.name}"
            poses, on_mount = _on_path(camera_log.mount, stamps[mine], valid[mine], boxes[mine], max_gap, ledger, what)
            base_T_camera[mine] = poses
            valid[mine] &= on_mount
    if not valid.any():
        raise LogError(
            f"none of the {len(stamps)} detection frames lies on the robot's path "
            f"(frames {stamps[0]:.3f} to {stamps[-1]:.3f} s, path {path.stamps[0]:.3f} to {path.stamps[-1]:.3f} s)",
            where=log.name,
            hint="do both use the same clock? poses.max_gap sets the longest gap that is bridged",
        )
    return Keyframes(
        stamps=stamps,
        camera=camera,
        frame=frame,
        base_T_camera=base_T_camera,
        map_T_base=map_T_base,
        localized_every=_sharing(log.localization, stamps[valid]) if log.localization else 0.0,
        odom_T_base=odom_T_base,
        drift=drift,
        stretch=stretch,
    ).take(valid)


def _boxes_per_frame(camera_log: CameraLog) -> Floats:
    detections = camera_log.detections
    if detections is None:
        return np.zeros(0)
    return np.bincount(detections.frame, minlength=len(detections.frame_stamps)).astype(float)


def _on_path(
    path: Trajectory, stamps: Floats, wanted: Bools, boxes: Floats, max_gap: float, ledger: Ledger, what: str
) -> tuple[Floats, Bools]:
    """The poses of a path at the stamps, and a mask of the stamps at which the path has a pose.

    Wanted frames without a pose, and their boxes, are counted as dropped.
    """
    poses, valid = interpolate(path.stamps, path.poses, stamps, max_gap)
    outside = (stamps < path.stamps[0]) | (stamps > path.stamps[-1])
    lost = wanted & ~valid
    for mask, why in ((lost & outside, f"before or after the {what}"), (lost & ~outside, f"in a gap of the {what}")):
        where = f"stamp {stamps[mask][0]:.3f}" if mask.any() else None
        ledger.drop(f"boxes {why}", int(boxes[mask].sum()), where)
        ledger.drop(f"frames {why}", int(mask.sum()), where)
    return poses, valid


def _stretches(odometry: Trajectory, stamps: Floats, max_gap: float) -> Ints:
    """The number (Q,) of the odometry's stretch that each of the stamps (Q,) lies on."""
    begin = odometry.stamps[1:][np.diff(odometry.stamps) > max_gap]
    return np.searchsorted(begin, stamps, side="right")


def _sharing(localization: Trajectory, stamps: Floats) -> float:
    measured = ((localization.stamps >= stamps[0]) & (localization.stamps <= stamps[-1])).sum()
    return max(1.0, len(stamps) / max(float(measured), 1.0))
