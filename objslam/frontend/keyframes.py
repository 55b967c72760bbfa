"""Select keyframes: camera frames whose pose is known from the robot's path."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import in_view
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import evenly_spread, interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.core.types import Keyframes, Log
from objslam.errors import LogError
from objslam.frontend.localization.measured_poses import with_measurements
from objslam.frontend.odometry_bridge import bridge_of
from objslam.frontend.odometry_drift import gathered_drift

OFF_PATH = ("boxes before or after the", "boxes in a gap of the")
"""The reasons to drop boxes without a pose of the robot. The name of the path follows each of them."""
UNCOVERED = "boxes that the localisation does not cover"
"""The reason for which a live session drops boxes at the end of the session."""
_DIRECTIONS = 400
"""The number of directions in which the views of several cameras are compared. A larger number is more exact and slower."""


def build_keyframes(log: Log, settings: Settings, ledger: Ledger, measured: Trajectory | None = None) -> Keyframes:
    """Return the frames of all cameras that lie on the robot's path, in the order of time.

    The path is the localisation if the log has one, else the odometry. In joint mode a frame must also lie on the odometry,
    because the odometry gives the motion between keyframes. Nothing is extrapolated. The ledger counts the frames and boxes
    that are outside the path or in one of its gaps longer than poses.max_gap. If a camera moves on the robot, the ledger
    also counts frames outside of the stamps of its mount. LogError if the log has no path, no detection frame, or no frame
    on the path.

    measured: the localisation before `continued_by_odometry` continued it, None if it was not continued.
    """
    path = log.robot_path
    if path is None:
        raise LogError("the log has neither odometry nor localisation", where=log.name, hint="give at least one of them")
    odometry = log.odometry if settings.mode == "joint" else None
    localized, max_gap = path is log.localization, settings.poses.max_gap

    found = [(index, c.detections) for index, c in enumerate(log.cameras) if c.detections is not None]
    if not any(len(detections.frame_stamps) for _, detections in found):
        raise LogError(
            "there are no detection frames", where=log.name, hint="give detections.jsonl, or --detector MODEL.onnx"
        )
    camera = np.concatenate([np.full(len(detections.frame_stamps), index) for index, detections in found])
    frame = np.concatenate([np.arange(len(detections.frame_stamps)) for _, detections in found])
    stamps = np.concatenate([detections.frame_stamps for _, detections in found])
    boxes = np.concatenate([np.bincount(d.frame, minlength=len(d.frame_stamps)).astype(float) for _, d in found])
    order = np.lexsort((camera, stamps))
    camera, frame, stamps, boxes = camera[order], frame[order], stamps[order], boxes[order]

    valid = np.ones(len(stamps), dtype=bool)
    what = "localisation" if localized else "odometry"
    map_T_base, on_path = _on_path(path, stamps, valid, boxes, max_gap, ledger, what)
    valid &= on_path
    odom_T_base, drift, stretch, step, wander = None, None, None, None, None
    if odometry is not None:
        odom_T_base, drift = map_T_base, gathered_drift(odometry, stamps, settings.odometry)
        if localized:
            odom_T_base, on_odometry = _on_path(odometry, stamps, valid, boxes, max_gap, ledger, "odometry")
            valid &= on_odometry
        odom_T_base = inverse(odometry.poses[0]) @ odom_T_base
        step, wander = bridge_of(odometry).at(stamps)
        gap_ends = odometry.stamps[1:][np.diff(odometry.stamps) > max_gap]
        stretch = np.searchsorted(gap_ends, stamps, side="right")
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
        if on_path.any():
            hint = "the odometry or camera_poses do not cover the frames on the path: check their stamps"
        elif ((stamps >= path.stamps[0]) & (stamps <= path.stamps[-1])).any() and len(path) > 1:
            every = float(np.median(np.diff(path.stamps)))
            hint = f"its poses are {every:.3g} s apart: raise poses.max_gap to bridge longer gaps"
            if localized and log.odometry is not None and settings.mode == "fixed":
                hint += ", or let the odometry bridge them (--mode joint)"
        else:
            hint = "check that both use the same clock"
        raise LogError(
            f"none of the {len(stamps)} detection frames lies on the robot's path "
            f"(frames {stamps[0]:.3f} to {stamps[-1]:.3f} s, path {path.stamps[0]:.3f} to {path.stamps[-1]:.3f} s)",
            where=log.name,
            hint=hint,
        )
    keyframes = Keyframes(
        stamps=stamps,
        camera=camera,
        frame=frame,
        base_T_camera=base_T_camera,
        map_T_base=map_T_base,
        overlap=_overlap(log, camera[valid]),
        odom_T_base=odom_T_base,
        drift=drift,
        stretch=stretch,
        step=step,
        wander=wander,
    ).take(valid)
    return with_measurements(keyframes, log, measured or path, settings) if localized else keyframes


def _overlap(log: Log, camera: Ints) -> float:
    """Return the share of the images of one moment that can show the same thing. camera: (K,) of each image.

    For each direction that an image shows, the share of all images that show this direction is taken, including the image
    itself. The result is the mean of the shares over all images and directions. A direction stands for a point far away. A
    camera that moves on the robot counts as if it were at its `base_T_camera`.
    """
    images = np.bincount(camera, minlength=len(log.cameras)) / len(camera)
    used = np.flatnonzero(images)
    if len(used) == 1:
        return 1.0
    shows = np.zeros(_DIRECTIONS)
    for index in used.tolist():
        one = log.cameras[index].camera
        seen, _ = in_view(one, evenly_spread(_DIRECTIONS) @ one.base_T_camera[:3, :3])
        shows[seen] += images[index]
    return float((shows**2).sum() / shows.sum()) if shows.any() else 1.0


def with_mounts(frames: Keyframes, log: Log) -> Keyframes:
    """Return frames with the mounts (base_T_camera) of another log. The two logs differ in their mounts only. No camera
    moves on the robot."""
    mounts = np.array([one.camera.base_T_camera for one in log.cameras])
    return replace(frames, base_T_camera=mounts[frames.camera], overlap=_overlap(log, frames.camera))


def with_given_stamps(frames: Keyframes, log: Log) -> Keyframes:
    """Return frames with `given_stamps`, their stamps in a log. log: the log of the frames, before any correction of its
    clocks."""
    stamps = frames.stamps.copy()
    for index, one in enumerate(log.cameras):
        mine = frames.camera == index
        if one.detections is not None:
            stamps[mine] = one.detections.frame_stamps[frames.frame[mine]]
    return replace(frames, given_stamps=stamps)


def _on_path(
    path: Trajectory, stamps: Floats, wanted: Bools, boxes: Floats, max_gap: float, ledger: Ledger, what: str
) -> tuple[Floats, Bools]:
    """Return the poses of a path at stamps, and which stamps have one. The ledger counts `wanted` frames that have none."""
    poses, valid = interpolate(path.stamps, path.poses, stamps, max_gap)
    outside = (stamps < path.stamps[0]) | (stamps > path.stamps[-1])
    lost = wanted & ~valid
    for mask, why in zip((lost & outside, lost & ~outside), OFF_PATH, strict=True):
        where = f"stamp {stamps[mask][0]:.3f}" if mask.any() else None
        ledger.drop(f"{why} {what}", int(boxes[mask].sum()), where)
        ledger.drop(f"{why.replace('boxes', 'frames')} {what}", int(mask.sum()), where)
    return poses, valid
