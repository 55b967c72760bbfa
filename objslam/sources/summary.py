"""A summary of a log for `objslam info`: its streams, its cameras and the data that a run needs but the log lacks."""

import math
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera, spoken_name
from objslam.core.statistics import RAYLEIGH_MEDIAN
from objslam.core.trajectory import Trajectory
from objslam.core.types import Detections, Images, Log
from objslam.frontend.log_part import part_in_words

FIND_BOXES = "run a detector on its images (--detector)"  # The advice for a camera with images but without detections.


_STEP = 10.0
"""The least length of a chord of a path, as a multiple of the standard deviation of the noise of its positions. At 10, noise
makes a path at most 1 % longer. A larger value cuts more corners."""


@dataclass(frozen=True)
class Timing:
    """The stamps of a stream: their count, the first and the last stamp (s), the mean rate (Hz) and the longest gap (s)."""

    count: int
    start: float
    end: float
    rate: float
    longest_gap: float


@dataclass(frozen=True)
class Stream:
    """One stream of a log. role: its use in a run. detail: a short description of its content."""

    role: str
    timing: Timing
    detail: str


@dataclass(frozen=True)
class Contents:
    """The summary of a log. missing: one line for each thing that a run needs but the log lacks. part: as in `Log`."""

    name: str
    streams: tuple[Stream, ...]
    cameras: tuple[Camera, ...]
    missing: tuple[str, ...]
    part: tuple[float | None, float | None] = (None, None)


def timing(stamps: Floats) -> Timing:
    """Return the timing of stamps (N,), s, in any order. N must be above 0. The rate is 0 if all stamps are equal."""
    times = np.sort(stamps)
    span = float(times[-1] - times[0])
    rate = (len(times) - 1) / span if span > 0 else 0.0
    gap = float(np.diff(times).max()) if len(times) > 1 else 0.0
    return Timing(len(times), float(times[0]), float(times[-1]), rate, gap)


def contents(log: Log) -> Contents:
    """Return the summary of a log."""
    streams = [_path("odometry", log.odometry), _path("localization", log.localization)]
    missing = []
    if log.robot_path is None:
        missing.append("there is neither odometry nor localisation")
    if not log.cameras:
        missing.append("there is no camera")
    for camera_log in log.cameras:
        name = f"{camera_log.camera.name}." if len(log.cameras) > 1 else ""
        streams += [
            _boxes(f"{name}detections", camera_log.detections),
            _images(f"{name}image", camera_log.rgb),
            _images(f"{name}depth", camera_log.depth),
            _path(f"{name}camera_poses", camera_log.mount),
        ]
        where, frames = spoken_name(camera_log.camera.name), np.zeros(0)
        if camera_log.detections is not None:
            frames = camera_log.detections.frame_stamps
        elif camera_log.rgb is not None:
            frames = camera_log.rgb.stamps
            missing.append(f"{where}: no detections; {FIND_BOXES}")
        else:
            missing.append(f"{where}: neither detections nor images")
        missing += off_path(where, frames, log.robot_path)
    if log.truth is not None:
        streams.append(_path("truth", log.truth.trajectory))
    cameras = tuple(camera_log.camera for camera_log in log.cameras)
    return Contents(log.name, tuple(stream for stream in streams if stream), cameras, tuple(missing), log.part)


def in_words(found: Contents) -> list[str]:
    """Return sentences that describe the robot's path and the data of each camera in a log."""
    by_role = {stream.role: stream for stream in found.streams}
    path = by_role.get("localization") or by_role.get("odometry")
    said = []
    if part := part_in_words(found.part):
        said.append(f"This is a part of the recording: {part}.")
    if path is not None:
        source = " and ".join(name for name in ("odometry", "localization") if name in by_role)
        said.append(f"The robot drives {path.detail} in {path.timing.end - path.timing.start:.1f} s, by {source}.")
    for camera in found.cameras:
        name = f"{camera.name}." if len(found.cameras) > 1 else ""
        boxes, images = by_role.get(f"{name}detections"), by_role.get(f"{name}image")
        seen = [boxes.detail + f" in {boxes.timing.count} frames"] if boxes else []
        seen += [f"{images.timing.count} images"] if images else []
        said.append(f"The {spoken_name(camera.name)} has {' and '.join(seen) or 'neither boxes nor images'}.")
    return said


def off_path(where: str, frames: Floats, path: Trajectory | None) -> list[str]:
    """Return a list of one message if no frame is within the time of the path. Return an empty list in all other cases.

    where: the name of the camera in the message. frames: (N,) stamps, s.
    """
    if path is None or len(frames) == 0 or ((frames >= path.stamps[0]) & (frames <= path.stamps[-1])).any():
        return []
    return [
        f"{where}: none of its frames ({frames.min():.3f} to {frames.max():.3f} s) is within the time of the path "
        f"({path.stamps[0]:.3f} to {path.stamps[-1]:.3f} s); check that both use one clock"
    ]


def _path(role: str, path: Trajectory | None) -> Stream | None:
    if path is None or len(path) == 0:
        return None
    return Stream(role, timing(path.stamps), f"{path_length(path.poses[:, :3, 3]):.1f} m")


def path_length(positions: Floats) -> float:
    """Return the length of a path, m, without the length that noise adds. positions: (N, 3), m.

    The length is a sum of chords. A chord goes from a position to the next one that is at least `_STEP` sigma away, where
    sigma is the standard deviation of the noise. The noise along a path cancels from chord to chord. The noise across the
    path makes a chord longer by the share (sigma / length)^2, which is at most 1 %. The noise is measured from the second
    differences of the positions, in which white noise is large and motion is small.
    """
    bends = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=1)
    sigma = float(np.median(bends)) / (RAYLEIGH_MEDIAN * np.sqrt(6.0)) if len(bends) else 0.0
    length, points = 0.0, positions.tolist()
    last = points[0]
    for point in points[1:]:  # The loop uses plain floats. It takes 1 s for a day of poses at 20 Hz.
        step = math.dist(last, point)
        if step >= _STEP * sigma:
            length, last = length + step, point
    return length


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
