"""Measure quickly how well the boxes of a log agree: fit points to the rays of each label, and count the boxes that fit.

Poses are not corrected. Odometry drifts, so a log without a localisation is cut into short windows. Each window has its own
points.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import is_planar
from objslam.core.ground.flattening import LEVEL, flat_scale, flattened_lines, noise_of_ground, raised_points
from objslam.core.types import CameraLog, Detections, Keyframes, Log, Rays
from objslam.errors import LogError
from objslam.frontend.bearings import CUT_OFF, build_rays
from objslam.frontend.keyframes import build_keyframes, with_mounts
from objslam.mapping.checks.meeting_points import fit_points
from objslam.mapping.standstills import repeated_views

FRAMES = 600
"""The most frames that are examined. More frames give a more certain answer and take longer."""
_WINDOWS = 6
"""The number of windows of a log without a localisation. More windows cover more of the log, with fewer frames each."""
_WAY, _TURN = 5.0, 5.0
"""The distance (m) and the turn (rad) that a window covers. Larger values see objects from more places, with more drift."""
_DRIFT_YAW, _DRIFT_XY = 0.015, 0.03
"""The errors (rad, m) that the odometry may have within a window. With larger values, wrong input may fit too."""
_SIGMAS = 3.0
"""The largest deviation of a ray that fits a point, in standard deviations. A larger value lets false rays fit."""
_COST = 3.0
"""The cost of a point in the score, as a number of fitting boxes: one box for each coordinate. With a larger number, points
with few boxes add less to the score."""
_AT_ONCE = 100_000
"""The most rays of several logs to which points are fitted at once. A larger number needs fewer passes and more memory."""


@dataclass(frozen=True)
class Agreement:
    """How well the boxes of a log agree with points.

    share: the share of the boxes that fit a point. score: the sum of `fit`, less three boxes for each point, as a share of
    the boxes. boxes: the number of boxes, including boxes without a ray. cut: the number of boxes that the image's edge cuts
    off. keyframes, rays: the measurements. point: (R,) the index of each ray's point in `points`, -1 for a ray without one.
    points: (N, 3) m. fit: (R,) how well each ray fits, 0 to 1. narrow: (R,) whether a ray neither fits nor misses, because
    the robot saw its thing from one direction only (`Meeting.narrow`).
    """

    share: float
    score: float
    boxes: int
    cut: int
    keyframes: Keyframes
    rays: Rays
    point: Ints
    points: Floats
    fit: Floats
    narrow: Bools


@dataclass(frozen=True)
class Part:
    """A part of a log with a limited number of frames.

    window: for each camera, the window of each of its frames. drifts: whether the poses are odometry.
    """

    log: Log
    window: tuple[Ints, ...]
    drifts: bool

    @property
    def boxes(self) -> int:
        """The number of boxes."""
        return sum(len(c.detections) for c in self.log.cameras if c.detections is not None)

    @cached_property
    def crowd(self) -> float:
        """The number of boxes of one label in one frame, as the mean over all boxes. In a crowd, rays meet by chance."""
        counts = [np.zeros(0)]
        for one in self.log.cameras:
            if one.detections is not None and len(one.detections):
                pairs = np.stack([one.detections.frame, one.detections.label])
                counts.append(np.unique(pairs, axis=1, return_counts=True)[1].astype(float))
        number = np.concatenate(counts)
        return float((number**2).sum() / max(number.sum(), 1.0))


def bounded_part(log: Log, settings: Settings) -> Part:
    """Return at most `FRAMES` frames of a log. The frames are spread evenly over the log. If the poses are odometry, the
    frames are in short windows.

    A robot that stands shows the same view again. Of such frames, only the first counts (`standstills.repeated_views`).
    """
    stamps = np.sort(np.concatenate([c.detections.frame_stamps for c in log.cameras if c.detections is not None]))
    drifts = log.localization is None
    if not drifts:
        starts, seconds = stamps[:1], np.inf
    else:
        seconds = _window_length(log)
        count = max(1, min(_WINDOWS, int((stamps[-1] - stamps[0]) / seconds)))
        starts = np.linspace(stamps[0], max(stamps[-1] - seconds, stamps[0]), count)
    most = FRAMES // len(starts)
    cameras, windows = [], []
    for one in log.cameras:
        found = one.detections
        if found is None:
            cameras.append(CameraLog(one.camera))
            windows.append(np.zeros(0, dtype=np.int64))
            continue
        window = np.searchsorted(starts, found.frame_stamps, side="right") - 1
        window[found.frame_stamps > starts[np.maximum(window, 0)] + seconds] = -1
        filled = np.bincount(found.frame, minlength=len(found.frame_stamps)) > 0
        kept = np.zeros(len(window), dtype=bool)
        for number in range(len(starts)):
            mine = np.flatnonzero((window == number) & filled)
            kept[mine[:: max(1, -(-len(mine) * len(log.cameras) // most))]] = True
        if one.mount is None:
            examined = np.flatnonzero(kept)
            kept[examined[repeated_views(log, found.frame_stamps[examined], settings)]] = False
        cameras.append(replace(one, detections=take_frames(one, kept), rgb=None, depth=None))
        windows.append(window[kept])
    return Part(replace(log, cameras=tuple(cameras), truth=None), tuple(windows), drifts)


@dataclass(frozen=True)
class _Measured:
    """The measurements of a log, as input of `fit_points`. origins, directions: (R, 3) in a world that is flattened by the
    factor `scale`. label: (R,) a number for each label and window. cut: the number of boxes cut off by the image's edge."""

    cut: int
    keyframes: Keyframes
    rays: Rays
    origins: Floats
    directions: Floats
    scale: float
    label: Ints


def agreement(part: Part, log: Log, settings: Settings) -> Agreement | None:
    """Return how well the boxes of a log agree, or None if no frame has a pose. log: has the frames of the part."""
    return next(agreements(part, (log,), settings))


def agreements(
    part: Part, logs: Iterable[Log], settings: Settings, window: tuple[Ints, ...] | None = None
) -> Iterator[Agreement | None]:
    """Yield the `agreement` of each of several logs. One log does not affect another, but together they take less time.

    window: for each camera, the windows of its frames, if they differ from the windows of the part.
    """
    waiting: list[_Measured | None] = []
    built: tuple[Log, Keyframes, Rays, int] | None = None
    for log in logs:
        built = _built(log, settings, built)
        waiting.append(None if built is None else _measure(part, *built[1:], settings, window))
        if sum(len(one.rays) for one in waiting if one is not None) > _AT_ONCE:
            yield from _fitted(part, waiting, settings)
            waiting = []
    yield from _fitted(part, waiting, settings)


def _built(
    log: Log, settings: Settings, before: tuple[Log, Keyframes, Rays, int] | None
) -> tuple[Log, Keyframes, Rays, int] | None:
    """Return a log, its keyframes, its rays, and the number of boxes that the image's edge cuts off. None if no frame has a
    pose.

    before: what this function returned for the previous log. Its rays are used again if the two logs differ only in the
    cameras' poses on the robot.
    """
    if before is not None and _differ_in_mounts(before[0], log):
        return log, with_mounts(before[1], log), *before[2:]
    free, ledger = settings.model_copy(update={"mode": "fixed"}), Ledger()
    try:
        keyframes = build_keyframes(log, free, Ledger())
        rays = build_rays(log, keyframes, free, ledger)
        return log, keyframes, rays, ledger.dropped.get(CUT_OFF, 0)
    except LogError:
        return None


def _differ_in_mounts(one: Log, other: Log) -> bool:
    """Return whether two logs share all their data but base_T_camera. False if a camera moves on the robot."""
    if one.localization is not other.localization or one.odometry is not other.odometry:
        return False
    parts = [f.name for f in fields(Camera) if f.name != "base_T_camera"]
    return all(
        a.mount is None
        and b.mount is None
        and a.detections is b.detections
        and all(getattr(a.camera, name) is getattr(b.camera, name) for name in parts)
        for a, b in zip(one.cameras, other.cameras, strict=True)
    )


def _measure(
    part: Part, keyframes: Keyframes, rays: Rays, cut: int, settings: Settings, window: tuple[Ints, ...] | None
) -> _Measured:
    windows = part.window if window is None else window
    of_keyframe = np.zeros(len(keyframes), dtype=np.int64)
    for index, mine in enumerate(windows):
        own = keyframes.camera == index
        of_keyframe[own] = mine[keyframes.frame[own]]
    label = rays.label + len(rays.label_names) * of_keyframe[rays.keyframe]
    scale = flat_scale(rays, _level_noise(part, settings), settings) if is_planar(keyframes.map_T_base) else LEVEL
    lines = flattened_lines(*rays.in_map(keyframes.map_T_camera), scale)
    return _Measured(cut, keyframes, rays, *lines[:2], scale, label)


def _fitted(part: Part, logs: list[_Measured | None], settings: Settings) -> Iterator[Agreement | None]:
    known = [one for one in logs if one is not None]
    if known:
        yaw, place = _level_noise(part, settings)
        begin = np.cumsum([0, *(one.label.max(initial=-1) + 1 for one in known)])
        label = np.concatenate([one.label + first for one, first in zip(known, begin[:-1], strict=True)])
        origins = np.concatenate([one.origins for one in known])
        directions = np.concatenate([one.directions for one in known])
        tolerance = _SIGMAS * np.hypot(np.concatenate([one.rays.sigma for one in known]), yaw)
        met = fit_points(origins, directions, tolerance, _SIGMAS * place, label, settings.seed)
    total, first = max(part.boxes, 1), 0
    for one in logs:
        if one is None:
            yield None
            continue
        mine = slice(first, first + len(one.rays))
        first = mine.stop
        number, own = np.unique(met.point[mine], return_inverse=True)
        number, own = number[number >= 0], own - (number < 0).any()
        fit = met.fit[mine]
        score = (fit.sum() - _COST * len(number)) / total
        share = float((own >= 0).sum() / total)
        of_log = total, one.cut, one.keyframes, one.rays
        points = raised_points(met.points[number], one.scale)
        yield Agreement(share, float(score), *of_log, own, points, fit, met.narrow[mine])


def pose_noise(part: Part, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of the rotation (rad) and of the position (m) of poses, in all directions together."""
    (yaw, place), (tilt, z) = _level_noise(part, settings), noise_of_ground(settings)
    return float(np.hypot(yaw, tilt)), float(np.hypot(place, z))


def _level_noise(part: Part, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of the heading (rad) and of the place in x and y (m) of poses."""
    if part.drifts:
        return _DRIFT_YAW, _DRIFT_XY
    return settings.localization.yaw, settings.localization.xy


def _window_length(log: Log) -> float:
    """Return the time (s) in which the odometry moves or turns as far as a window covers. The time is at least 10
    and at most 120 s. It is infinite without odometry."""
    path = log.odometry
    if path is None or len(path) < 2:
        return np.inf
    way = np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1)
    turned = np.einsum("nij,nij->n", path.poses[1:, :3, :3], path.poses[:-1, :3, :3])
    angle = np.arccos(np.clip((turned - 1) / 2, -1.0, 1.0))
    seconds = float(path.stamps[-1] - path.stamps[0])
    return float(np.clip(seconds / max(way.sum() / _WAY, angle.sum() / _TURN, 1e-9), 10.0, 120.0))


def take_frames(one: CameraLog, kept: Bools) -> Detections:
    """Return the detections of a camera in some of its frames. kept: (F,) which frames to take."""
    found = one.detections
    assert found is not None
    boxes = found.take(kept[found.frame])
    number = np.cumsum(kept) - 1
    return replace(boxes, frame_stamps=found.frame_stamps[kept], frame=number[boxes.frame])
