"""What is inside a log that was read, of whatever kind, and what a run would miss in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.types import CameraLog, Detections, Images, Log, Trajectory


@dataclass(frozen=True)
class Timing:
    """When the messages of a stream come: how many, the first and the last (s), rate (Hz), the longest gap (s)."""

    count: int
    start: float
    end: float
    rate: float
    longest_gap: float


@dataclass(frozen=True)
class Stream:
    """One stream of a log. role: what a run uses it for. detail: what it holds, in a few words."""

    role: str
    timing: Timing
    detail: str


@dataclass(frozen=True)
class Contents:
    """A log at a glance: its streams, its cameras, and what a run needs and does not find."""

    name: str
    streams: tuple[Stream, ...]
    cameras: tuple[Camera, ...]
    missing: tuple[str, ...]


def timing(stamps: Floats) -> Timing:
    """The timing of stamps (N,), N > 0, in any order."""
    times = np.sort(stamps)
    span = float(times[-1] - times[0])
    return Timing(
        count=len(times),
        start=float(times[0]),
        end=float(times[-1]),
        rate=(len(times) - 1) / span if span > 0 else 0.0,
        longest_gap=float(np.diff(times).max()) if len(times) > 1 else 0.0,
    )


def contents(log: Log) -> Contents:
    """What a log holds."""
    streams = [_path("odometry", log.odometry), _path("localization", log.localization)]
    for camera_log in log.cameras:
        name = f"{camera_log.camera.name}." if len(log.cameras) > 1 else ""
        streams += [
            _boxes(f"{name}detections", camera_log.detections),
            _images(f"{name}image", camera_log.rgb),
            _images(f"{name}depth", camera_log.depth),
            _path(f"{name}camera_poses", camera_log.mount),
        ]
    if log.truth is not None:
        streams.append(_path("truth", log.truth.trajectory))
    cameras = tuple(camera_log.camera for camera_log in log.cameras)
    return Contents(log.name, tuple(s for s in streams if s is not None), cameras, _missing(log))


def _missing(log: Log) -> tuple[str, ...]:
    missing = []
    if log.odometry is None and log.localization is None:
        missing.append("there is neither odometry nor localisation")
    if not log.cameras:
        missing.append("there is no camera")
    for camera_log in log.cameras:
        where = f"camera {camera_log.camera.name}"
        frames = _frames(camera_log)
        if camera_log.detections is None:
            images = "run a detector on its images (--detector)" if camera_log.rgb is not None else "and no images either"
            missing.append(f"{where}: no detections; {images}")
        missing += off_path(where, frames, log.localization or log.odometry)
    return tuple(missing)


def off_path(where: str, frames: Floats, path: Trajectory | None) -> list[str]:
    """What to say where none of a camera's frames (N,), s, lies on the path; nothing where one does."""
    if path is None or len(frames) == 0 or ((frames >= path.stamps[0]) & (frames <= path.stamps[-1])).any():
        return []
    return [
        f"{where}: none of its frames ({frames.min():.3f} to {frames.max():.3f} s) is on the path "
        f"({path.stamps[0]:.3f} to {path.stamps[-1]:.3f} s); do both use one clock?"
    ]


def _frames(camera_log: CameraLog) -> Floats:
    if camera_log.detections is not None:
        return camera_log.detections.frame_stamps
    return np.zeros(0) if camera_log.rgb is None else camera_log.rgb.stamps


def _path(role: str, path: Trajectory | None) -> Stream | None:
    if path is None or len(path) == 0:
        return None
    way = np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1).sum()
    return Stream(role, timing(path.stamps), f"{way:.1f} m")


def _boxes(role: str, detections: Detections | None) -> Stream | None:
    if detections is None or len(detections.frame_stamps) == 0:
        return None
    labels = len(np.unique(detections.label))
    known = int(np.isfinite(detections.depths).sum())
    detail = f"{len(detections)} boxes of {labels} label{'s' if labels != 1 else ''}" + f", {known} with depth" * (known > 0)
    return Stream(role, timing(detections.frame_stamps), detail)


def _images(role: str, images: Images | None) -> Stream | None:
    if images is None or not images.paths:
        return None
    endings = sorted({path.suffix.lstrip(".") or "?" for path in images.paths})
    return Stream(role, timing(images.stamps), f"{', '.join(endings)} files")
