"""Measure quickly how well the boxes of a log agree: fit points to the rays of each label, and count the boxes that fit.

Poses are not corrected. Odometry drifts, so a log without a localisation is cut into short windows. Each window has its own
points.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Keyframes, Log, Rays
from objslam.errors import LogError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes

FRAMES = 600
"""The most frames that are examined. More frames give a more certain answer and take longer."""
_WINDOWS = 6
"""The number of windows of a log without a localisation. More windows cover more of the log, with fewer frames each."""
_WAY, _TURN = 5.0, 5.0
"""The distance (m) and the turn (rad) that a window covers. Larger values see objects from more places, with more drift."""
_DRIFT_YAW, _DRIFT_XY = 0.015, 0.03
"""The errors (rad, m) that the odometry may have within a window. With larger values, wrong input may fit too."""
_SIGMAS = 3.0
"""The deviation of a ray from its point, in standard deviations, up to which it fits. A larger value lets false rays fit."""
_PAIRS = 96
"""The number of tried pairs of rays for a point. More pairs find points with fewer rays, and take longer."""
_JUDGES = 400
"""The most rays of a label that choose among the tried points. More rays choose better, and take longer in a crowd."""
_FEWEST = 4
"""The fewest rays of a point. Fewer rays agree by chance."""
_LEAST_ANGLE = np.radians(4.0)
"""The least angle between the rays of a point (rad). Rays with a smaller angle agree even if the input is wrong."""
_NEAREST = 0.25
"""The least distance (m) of a point from a camera. Rays of a turning camera meet in the camera itself."""
_COST = 3.0
"""The number of boxes that a point must explain before it counts, one for each coordinate. A larger number drops points with
few boxes."""
_MOST_POINTS = 40
"""The most points of one label in a window. More points explain more boxes by chance."""


@dataclass(frozen=True)
class Agreement:
    """How well boxes agree. share: the share of the boxes that fit a point. score: the share with weights and costs. A box
    that fits worse has less weight, and each point costs three boxes.

    boxes: the number of boxes, including boxes without a ray. keyframes, rays: the measurements. point: (R,) the index into
    points of each ray, -1 for none. points: (N, 3) m. fit: (R,) how well each ray fits, 0 to 1.
    """

    share: float
    score: float
    boxes: int
    keyframes: Keyframes
    rays: Rays
    point: Ints
    points: Floats
    fit: Floats


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

    @property
    def crowd(self) -> float:
        """The mean number of boxes in a box's frame with its label, itself included. In a crowd, rays meet by chance."""
        counts = [np.zeros(0)]
        for one in self.log.cameras:
            if one.detections is not None and len(one.detections):
                pairs = np.stack([one.detections.frame, one.detections.label])
                counts.append(np.unique(pairs, axis=1, return_counts=True)[1].astype(float))
        number = np.concatenate(counts)
        return float((number**2).sum() / max(number.sum(), 1.0))


def bounded_part(log: Log, settings: Settings) -> Part:
    """Return at most `FRAMES` frames of a log. They are spread evenly, or in short windows if the poses are odometry."""
    stamps = np.sort(np.concatenate([c.detections.frame_stamps for c in log.cameras if c.detections is not None]))
    drifts = log.localization is None
    if not drifts:
        starts, seconds = stamps[:1], np.inf
    else:
        seconds = _window_length(log, settings)
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
        cameras.append(replace(one, detections=_take_frames(one, kept), rgb=None, depth=None))
        windows.append(window[kept])
    return Part(replace(log, cameras=tuple(cameras), truth=None), tuple(windows), drifts)


def agreement(part: Part, log: Log, settings: Settings, window: tuple[Ints, ...] | None = None) -> Agreement | None:
    """Return how well the boxes of a log agree. `log` has the frames of the part. None if no frame has a pose.

    window: for each camera, the windows of its frames, if they are not those of the part.
    """
    free = settings.model_copy(update={"mode": "fixed"})
    try:
        keyframes = build_keyframes(log, free, Ledger())
        rays = build_rays(log, keyframes, free, Ledger())
    except LogError:
        return None
    windows = part.window if window is None else window
    of_keyframe = np.zeros(len(keyframes), dtype=np.int64)
    for index, mine in enumerate(windows):
        own = keyframes.camera == index
        of_keyframe[own] = mine[keyframes.frame[own]]
    yaw, place = pose_noise(part, settings)
    origins, directions = rays.in_map(keyframes.map_T_camera)
    tolerance = _SIGMAS * np.hypot(rays.sigma, yaw)
    label = rays.label + len(rays.label_names) * of_keyframe[rays.keyframe]
    point, points, gain = _fit_points(origins, directions, tolerance, _SIGMAS * place, label, settings.seed)
    total = max(part.boxes, 1)
    score = (gain.sum() - _COST * len(points)) / total
    return Agreement(float((point >= 0).sum() / total), float(score), total, keyframes, rays, point, points, gain)


def pose_noise(part: Part, settings: Settings) -> tuple[float, float]:
    """Return the pose errors (rad, m) that a ray may have."""
    if part.drifts:
        return _DRIFT_YAW, _DRIFT_XY
    return settings.localization.yaw, settings.localization.xy


def _window_length(log: Log, settings: Settings) -> float:
    """Return the time (s), 10 to 120, in which the odometry moves or turns as far as a window covers. It is infinite without
    odometry."""
    path = log.odometry
    if path is None or len(path) < 2:
        return np.inf
    way = np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1)
    turned = np.einsum("nij,nij->n", path.poses[1:, :3, :3], path.poses[:-1, :3, :3])
    angle = np.arccos(np.clip((turned - 1) / 2, -1.0, 1.0))
    seconds = float(path.stamps[-1] - path.stamps[0])
    return float(np.clip(seconds / max(way.sum() / _WAY, angle.sum() / _TURN, 1e-9), 10.0, 120.0))


def _take_frames(one: CameraLog, kept: Bools) -> Detections:
    found = one.detections
    assert found is not None
    boxes = found.take(kept[found.frame])
    number = np.cumsum(kept) - 1
    return replace(boxes, frame_stamps=found.frame_stamps[kept], frame=number[boxes.frame])


def _fit_points(
    origins: Floats, directions: Floats, tolerance: Floats, place: float, label: Ints, seed: int
) -> tuple[Ints, Floats, Floats]:
    """Fit points to the rays of each label. Return each ray's point (R,), the points (N, 3), and each ray's fit (R,).

    tolerance: (R,) rad. place: m. A ray fits up to its tolerance times the distance, plus place, added in quadrature.
    """
    rng = np.random.default_rng(seed)
    point, gain = np.full(len(label), -1), np.zeros(len(label))
    points: list[Floats] = []
    order = np.argsort(label, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        for mine, where, fit in _points_of(origins[group], directions[group], tolerance[group], place, rng):
            point[group[mine]], gain[group[mine]] = len(points), fit
            points.append(where)
    return point, np.array(points).reshape(-1, 3), gain


def _points_of(
    origins: Floats, directions: Floats, tolerance: Floats, place: float, rng: np.random.Generator
) -> Iterator[tuple[Ints, Floats, Floats]]:
    """Yield for each point its rays, the point (3,), and how well each ray fits. The best point comes first."""
    left = np.arange(len(origins))
    for _ in range(_MOST_POINTS):
        if len(left) < _FEWEST:
            return
        o, d, t = origins[left], directions[left], tolerance[left]
        where = _meeting_points(o, d, rng)
        if not len(where):
            return
        few = rng.choice(len(left), _JUDGES, replace=False) if len(left) > _JUDGES else slice(None)
        best = where[int(_fit(o[few], d[few], t[few], place, where).sum(axis=1).argmax())]
        fit = _fit(o, d, t, place, best[None])[0]
        for _ in range(2):  # Each pass is a least-squares fit to the rays that fit now.
            inside = fit > 0
            if inside.sum() < _FEWEST:
                return
            moved = nearest_point(o[inside], d[inside], best)
            other = _fit(o, d, t, place, moved[None])[0]
            if other.sum() <= fit.sum():
                break
            best, fit = moved, other
        inside = fit > 0
        to = best - o[inside]
        to /= np.linalg.norm(to, axis=1, keepdims=True)
        if inside.sum() < _FEWEST or (to @ to[0]).min() > np.cos(_LEAST_ANGLE):
            return
        yield left[inside], best, fit[inside]
        left = left[~inside]


def _meeting_points(origins: Floats, directions: Floats, rng: np.random.Generator) -> Floats:
    """Return the points (P, 3) where random pairs of rays meet ahead of both cameras."""
    a, b = rng.integers(len(origins), size=(2, _PAIRS))
    cos = np.einsum("ni,ni->n", directions[a], directions[b])
    between = origins[b] - origins[a]
    sin2 = 1 - cos**2
    fine = sin2 > np.sin(_LEAST_ANGLE / 2) ** 2
    along_a, along_b = (np.einsum("ni,ni->n", between, directions[k]) for k in (a, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (along_a - cos * along_b) / sin2, (cos * along_a - along_b) / sin2
    fine &= (s > _NEAREST) & (t > _NEAREST)
    one, two = origins[a] + s[:, None] * directions[a], origins[b] + t[:, None] * directions[b]
    return np.asarray((one + two)[fine] / 2)


def _fit(origins: Floats, directions: Floats, tolerance: Floats, place: float, points: Floats) -> Floats:
    """Return how well each ray fits each point (P, R): 1 on the ray, 0 from the tolerance on."""
    to = points[:, None] - origins
    along = np.einsum("pri,ri->pr", to, directions)
    squared = np.einsum("pri,pri->pr", to, to)
    across = np.maximum(squared - along**2, 0.0)
    allowed = tolerance**2 * squared + place**2
    fit = 1 - across / np.maximum(allowed, 1e-12)
    return np.where((along > _NEAREST) & (fit > 0), fit, 0.0)


def nearest_point(origins: Floats, directions: Floats, start: Floats) -> Floats:
    """Return the point (3,) that is nearest to rays in least squares of angles. start: (3,) a point near it, whose distances
    turn offsets into angles."""
    weight = 1 / np.maximum(((start - origins) ** 2).sum(axis=1), _NEAREST**2)
    across = weight[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None, :])
    matrix, vector = across.sum(axis=0), np.einsum("rij,rj->i", across, origins)
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), vector + 1e-9 * start))
