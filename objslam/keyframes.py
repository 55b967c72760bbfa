"""Keyframes: camera frames with a pose, read off the robot's path at their stamps."""

from __future__ import annotations

import numpy as np

from objslam.config import Odometry, Settings
from objslam.errors import LogError
from objslam.geometry import adjoint, interpolate, inverse, is_planar, twist_length, twist_lengths
from objslam.ledger import Ledger
from objslam.types import Bools, CameraLog, Floats, Keyframes, Log, Trajectory


def build_keyframes(log: Log, settings: Settings, ledger: Ledger) -> Keyframes:
    """The frames of all cameras that lie on the robot's path, in the order of time.

    The path is the localisation where there is one, else the odometry. In joint mode a frame must also lie on the odometry
    if there is one, for the motion between keyframes. Frames outside a path, or in a gap longer than poses.max_gap, are
    dropped and counted with their boxes; nothing is extrapolated. LogError when no frame is left.
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
    odom_T_base, drift = None, None
    if odometry is not None:
        odom_T_base, drift = map_T_base, gathered_drift(odometry, stamps, settings.odometry)
        if log.localization is not None:
            odom_T_base, on_odometry = _on_path(odometry, stamps, valid, boxes, max_gap, ledger, "odometry")
            valid &= on_odometry
        odom_T_base = inverse(odometry.poses[0]) @ odom_T_base
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
    ).take(valid)


def _boxes_per_frame(camera_log: CameraLog) -> Floats:
    detections = camera_log.detections
    if detections is None:
        return np.zeros(0)
    return np.bincount(detections.frame, minlength=len(detections.frame_stamps)).astype(float)


def _on_path(
    path: Trajectory, stamps: Floats, wanted: Bools, boxes: Floats, max_gap: float, ledger: Ledger, what: str
) -> tuple[Floats, Bools]:
    """The poses of a path at the stamps, and where it has one; frames that were still wanted are counted where not."""
    poses, valid = interpolate(path.stamps, path.poses, stamps, max_gap)
    outside = (stamps < path.stamps[0]) | (stamps > path.stamps[-1])
    lost = wanted & ~valid
    for mask, why in ((lost & outside, f"before or after the {what}"), (lost & ~outside, f"in a gap of the {what}")):
        where = f"stamp {stamps[mask][0]:.3f}" if mask.any() else None
        ledger.drop(f"boxes {why}", int(boxes[mask].sum()), where)
        ledger.drop(f"frames {why}", int(mask.sum()), where)
    return poses, valid


def _sharing(localization: Trajectory, stamps: Floats) -> float:
    measured = ((localization.stamps >= stamps[0]) & (localization.stamps <= stamps[-1])).sum()
    return max(1.0, len(stamps) / max(float(measured), 1.0))


def correct_path(path: Trajectory, stamps: Floats, before: Floats, after: Floats) -> Trajectory:
    """The whole path, moved as its keyframes were: at their stamps (K,) from poses before to poses after, (K, 4, 4) each."""
    return Trajectory(path.stamps, correct_poses(path.stamps, path.poses, stamps, before, after))


def correct_poses(stamps: Floats, poses: Floats, keyframe_stamps: Floats, before: Floats, after: Floats) -> Floats:
    """Poses (N, 4, 4) at stamps (N,), moved as the keyframes at theirs (K,) were: from before to after, (K, 4, 4) each.

    Between two keyframes the correction goes over from the one's to the other's; beyond the first and last it stays.
    """
    known, first = np.unique(keyframe_stamps, return_index=True)
    correction = after[first] @ inverse(before[first])
    at, _ = interpolate(known, correction, np.clip(stamps, known[0], known[-1]), np.inf)
    return at @ poses


def gathered_drift(odometry: Trajectory, stamps: Floats, settings: Odometry) -> Floats:
    """Covariance (Q, 6, 6) that the odometry has gathered by each of the stamps (Q,), in the frame of its first pose.

    Each step brings noise of its own in base, growing with the way driven and the angle turned (a planar path: x, y, yaw;
    else all six); it is moved to the common frame by the adjoint, where steps simply add up. Between two stamps i < j, moved
    back to base at j, drift[j] - drift[i] is then the covariance of the motion, lever arms of the heading included.
    """
    start_T_base = inverse(odometry.poses[0]) @ odometry.poses
    steps = step_drift(start_T_base, settings, planar=is_planar(start_T_base))
    total = np.zeros((len(odometry), 36))
    np.cumsum(steps.reshape(-1, 36), axis=0, out=total[1:])
    if len(odometry) == 1:
        return np.zeros((len(stamps), 6, 6))
    after = np.clip(np.searchsorted(odometry.stamps, stamps), 1, len(odometry) - 1)
    span = odometry.stamps[after] - odometry.stamps[after - 1]
    share = np.clip((stamps - odometry.stamps[after - 1]) / span, 0.0, 1.0)[:, None]
    return ((1 - share) * total[after - 1] + share * total[after]).reshape(-1, 6, 6)


def step_drift(start_T_base: Floats, settings: Odometry, planar: bool) -> Floats:
    """Covariances (N-1, 6, 6) that the steps between poses (N, 4, 4) add, in the frame that the poses are given in."""
    turn, way = twist_lengths(inverse(start_T_base[:-1]) @ start_T_base[1:])
    angle = settings.yaw_per_m**2 * way + settings.yaw_per_rad**2 * turn
    x = settings.x_per_m**2 * way + settings.xy_per_rad**2 * turn
    y = settings.y_per_m**2 * way + settings.xy_per_rad**2 * turn
    none = np.zeros_like(way)
    noise = np.stack([none, none, angle, x, y, none] if planar else [angle, angle, angle, x, x, x], axis=1)
    moved = adjoint(start_T_base[1:])
    return np.asarray(np.einsum("nij,nj,nkj->nik", moved, noise, moved))


def add_step(drift: Floats, before: Floats, after: Floats, settings: Odometry, planar: bool) -> Floats:
    """The covariance drift (6, 6) and what `step_drift` adds to it for the step between two poses (4, 4).

    In a tenth of its time, most of all after a pause, for it hardly needs numpy: a session asks for every pose as it comes.
    """
    turn, way = twist_length(before, after)
    angle = settings.yaw_per_m**2 * way + settings.yaw_per_rad**2 * turn
    x = settings.x_per_m**2 * way + settings.xy_per_rad**2 * turn
    total = drift.copy()
    if not planar:
        moved = adjoint(after)
        total += (moved * [angle, angle, angle, x, x, x]) @ moved.T
        return total
    y = settings.y_per_m**2 * way + settings.xy_per_rad**2 * turn
    (c, _, _, px), (s, _, _, py) = after[:2].tolist()
    yaw_x, yaw_y, xy = angle * py, -angle * px, -angle * px * py + (x - y) * c * s
    total[2:5, 2:5] += [
        [angle, yaw_x, yaw_y],
        [yaw_x, angle * py * py + x * c * c + y * s * s, xy],
        [yaw_y, xy, angle * px * px + x * s * s + y * c * c],
    ]
    return total
