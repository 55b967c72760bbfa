"""Find boxes that stay at one place of the image while the camera turns, such as those of a part of the robot.

A thing at rest stays at one place only if the robot drives around it. Then the rays of its boxes meet in front of the
camera.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from objslam.association.observations import overlap
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, spoken_name, undistort
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log

ROBOT_PARTS = "boxes that stay at one place of the image while the camera turns (a part of the robot; rays.robot_parts)"
"""The reason to drop boxes of parts of the robot."""
FEWEST = 20
"""The fewest boxes at one place of the image that may show a part of the robot. A larger number drops fewer boxes."""
SAME_BOX, LIKE_BOX = 0.7, 0.3
"""Boxes are at one place of the image if their intersection over union with one box is above the first value. Boxes above
the second value are near that place. With a larger first value, only steadier boxes are found."""
STEADY = 0.5
"""The least share of the boxes near a place that must be at the place. A part of the robot has a share of 0.9 and more.
Random boxes have ((1 - 0.7) / (1 - 0.3))^4 = 0.03 if their four coordinates are independent, and up to 0.1 if their sizes
are similar. A larger share drops fewer boxes."""
_TENTHS = 6
"""The frames are split into ten equal parts (tenths). The boxes of a place must be in at least this number of tenths. A
robot that waits, or follows somebody for a while, sees boxes at one place in fewer tenths. A larger number drops fewer
boxes."""
_OFTEN = 0.1
"""The least share of the frames of a tenth that must have the box, so that the tenth counts. A detector may miss a part of
the robot in most images. A larger share drops fewer boxes."""
_TRIED, _COUNTED, _PLACES = 64, 4096, 16
"""Limits of the search for the image place with the most boxes, for each label and camera. For each place, at most `_TRIED`
boxes are compared with at most `_COUNTED` boxes, to find the box with the most boxes around it. At most `_PLACES` places are
tried. Larger numbers find rarer boxes, and take more time. The first two also take memory: without limits, 600,000 boxes of
one label would take gigabytes."""
TURN = np.radians(30.0)
"""The angle (rad) by which the camera turns in a window. Odometry is good over such a turn, and a thing at rest moves by
much of the image. A larger angle needs more turning."""
ABSENT = 10.0
"""A window ends at a gap (frames) between consecutive boxes of a place above this multiple of the usual gap. A part of the
robot stays while the camera turns. Things that the robot meets again on its way come and go. A larger number drops more
boxes."""
_MISSED = np.radians(5.0)
"""The angle (rad, root mean square) by which rays miss the point that fits them best. A window with a larger angle shows no
thing at rest. The errors of poses are smaller over such a turn. If the camera turns in its place, rays of boxes that stay in
the image miss the point by about 8.7 degrees (30 degrees / sqrt(12)). A larger angle drops fewer boxes."""
_BEHIND = 0.2
"""The share of the rays of a window for which the point that fits best is behind the camera. A window with a larger share
shows no thing at rest. A larger share drops fewer boxes."""
NEXT = 2
"""The most windows after a window whose rays are tested together with its own. Odometry is still good over the 90 degrees of
three windows. With 1, a part of the robot was not found for a camera that looks to the side, because the curves of the robot
changed slowly. A larger number drops more boxes."""
_DRIFTING = 4.0
"""Boxes drift if the mean change of a coordinate from one image to the next exceeds this number of standard deviations of
the mean. A robot that drives along a row of equal things sees one thing after another at the same place of the image, and
each grows or moves on. Boxes of a part of the robot change by noise alone. A larger number drops more boxes."""
WINDOWS, AGREE = 3, 0.8
"""`WINDOWS` is the least number, and `AGREE` the least share, of the windows that must show no thing at rest. Larger values
drop fewer boxes. Two boxes are enough for a window, because rays of a part of the robot mostly meet behind the camera."""


def without_robot_parts(log: Log, settings: Settings, ledger: Ledger) -> Log:
    """Return the log without the boxes of parts of the robot. The ledger counts the dropped boxes.

    A camera that moves on the robot keeps all boxes.
    """
    path = log.odometry or log.localization  # The odometry first, because it does not jump.
    if path is None or not settings.rays.robot_parts:
        return log
    return replace(log, cameras=tuple(_cleaned(one, path, settings, ledger) for one in log.cameras))


def _cleaned(one: CameraLog, path: Trajectory, settings: Settings, ledger: Ledger) -> CameraLog:
    found = one.detections
    if found is None or one.mount is not None or len(found) < FEWEST:
        return one
    poses, known = interpolate(path.stamps, path.poses, found.frame_stamps, settings.poses.max_gap)
    part = np.zeros(len(found), dtype=bool)
    for group in _steady(found, known[found.frame] & (found.scores >= settings.rays.min_score)):
        if not _drifts(found, group) and _never_rests(found, group, poses @ one.camera.base_T_camera, one.camera):
            part[group] = True
            label = found.label_names[found.label[group[0]]]
            where = f"{spoken_name(one.camera.name)}, stamp {found.stamps[group[0]]:.3f}, label {label}"
            ledger.drop(ROBOT_PARTS, len(group), where)
    if not part.any():
        return one
    ledger.drop(ROBOT_PARTS, 0, of=len(found))
    return replace(one, detections=found.take(np.flatnonzero(~part)))


def _steady(found: Detections, usable: Bools) -> Iterator[Ints]:
    """Yield groups of boxes of one label that stay at one place of the image during most of the log."""
    frames = len(found.frame_stamps)
    tenth = np.arange(frames) * 10 // frames
    often = _OFTEN * np.bincount(tenth, minlength=10)
    for label in np.unique(found.label[usable]).tolist():
        mine = np.flatnonzero(usable & (found.label == label))
        for _ in range(_PLACES):
            if len(mine) < FEWEST:
                break
            some, counted = (found.boxes[mine[_spread(len(mine), most)]] for most in (_TRIED, _COUNTED))
            there = overlap(some[:, None], counted[None]) >= SAME_BOX
            best = there[there.sum(axis=1).argmax()]
            alike = overlap(np.median(counted[best], axis=0), found.boxes[mine]) if best.any() else np.zeros(len(mine))
            group = mine[alike >= SAME_BOX]
            seen = np.bincount(tenth[np.unique(found.frame[group])], minlength=10)
            if len(group) < FEWEST or (seen >= often).sum() < _TENTHS:
                break
            if len(group) >= STEADY * (alike >= LIKE_BOX).sum():
                yield group
            mine = mine[alike < SAME_BOX]


def drifts(count: int, total: Floats, squares: Floats) -> bool:
    """Return whether boxes at one place of the image move on, from their changes from one image to the next.

    count: the number of changes. total, squares: (4,) px and px^2, the sums of the changes of each coordinate and of their
    squares.
    """
    if count < FEWEST / 2:
        return False
    mean = total / count
    deviation = np.sqrt(np.maximum(squares / count - mean**2, 1e-12) / count)
    return bool((np.abs(mean) > _DRIFTING * deviation).any())


def _drifts(found: Detections, group: Ints) -> bool:
    """Return whether boxes (M,) at one place of the image move on (`drifts`)."""
    order = group[np.argsort(found.frame[group], kind="stable")]
    next_ = np.flatnonzero(np.diff(found.frame[order]) == 1)
    change = found.boxes[order[next_ + 1]] - found.boxes[order[next_]]
    return drifts(len(change), change.sum(axis=0), (change**2).sum(axis=0))


def _spread(number: int, most: int) -> Ints:
    """Return at most `most` indices below a number, spread evenly."""
    return np.linspace(0, number - 1, min(most, number)).astype(np.int64)


def _never_rests(found: Detections, group: Ints, map_T_camera: Floats, camera: Camera) -> bool:
    """Return whether no thing at rest explains boxes (M,) at one place of the image. map_T_camera: (F, 4, 4) of frames.

    A camera that looks to the side of the robot has rays that meet in the middle of the curve that the robot drives. So the
    rays of a window must also meet together with those of the next windows, in which the robot drives other curves.
    """
    middle = (found.boxes[group, :2] + found.boxes[group, 2:]) / 2
    direction, valid = undistort(camera, middle)
    frame = found.frame[group[valid]]
    poses, gaps = map_T_camera[frame], np.diff(frame)
    breaks = np.flatnonzero(gaps > ABSENT * np.median(gaps)) + 1 if len(gaps) else gaps
    direction, origin = np.einsum("mij,mj->mi", poses[:, :3, :3], direction[valid]), poses[:, :3, 3]
    windows = list(_windows(poses[:, :3, 2], breaks))
    missed = 0
    for number, first in enumerate(windows):
        after = windows[number : number + NEXT + 1]
        longer = (slice(first.start, last.stop) for last in after if not _any_between(breaks, first.start, last.stop))
        missed += any(misses(origin[part], direction[part]) for part in longer)
    return missed >= max(WINDOWS, AGREE * len(windows))


def _any_between(values: Ints, low: int, high: int) -> bool:
    return bool(((values > low) & (values < high)).any())


def _windows(ahead: Floats, breaks: Ints) -> Iterator[slice]:
    """Yield windows of boxes, in each of which the camera turns by `TURN`.

    ahead: (M, 3) the direction of the camera's axis at each box. breaks: the boxes that follow a long time without a box. A
    window never continues over a break.
    """
    for first, end in pairwise([0, *breaks.tolist(), len(ahead)]):
        while len(turned := np.flatnonzero(ahead[first:end] @ ahead[first] < np.cos(TURN))):
            last = first + int(turned[0])
            yield slice(first, last + 1)
            first = last


def misses(origin: Floats, direction: Floats) -> bool:
    """Return whether no point explains rays (M, 3)."""
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    point = np.linalg.lstsq(across.sum(axis=0), np.einsum("mij,mj->i", across, origin), rcond=None)[0]
    way = point - origin
    along = np.einsum("mi,mi->m", way, direction)
    aside = np.linalg.norm(np.cross(way, direction), axis=1)
    off = np.arctan2(aside, np.abs(along))
    return bool((along < 0).mean() > _BEHIND or np.sqrt((off**2).mean()) > _MISSED)
