"""Detect that somebody turned a camera on the robot in the middle of a log.

All other errors of a camera are the same in both halves: its clock, its place, its lens, and the rotation that it had at
first. They are estimated together with the turn. Otherwise, these errors look like a turn: a late clock moves all rays to
one side while the robot turns left, and to the other side while the robot turns right.

The errors of poses last for seconds, and many boxes share them. The covariance of an estimate treats the boxes as
independent, so it is too small at the poses of a particle filter. So the estimate is repeated without each eighth of the
boxes. The changes of the estimate show its real error (jackknife with blocks, Kuensch 1989). A turn must be far larger than
this error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import Calibration, kind
from objslam.core.types import CameraLog
from objslam.frontend.corrected_log import take_out
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.checks.agreement import Part, agreement, take_frames
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.usual_errors import without_usual_errors

_AXES = ("yaw", "tilt", "roll")
_LATER = ", second half"  # What the name of a camera of the second half ends with.
_TURN = 0.2
"""The prior standard deviation (rad) of a turn. With a larger value, larger turns are found."""
_SAME = 1e-3
"""The prior standard deviation of the change of all other errors, as a share of the prior standard deviation of the errors.
The graph divides by this share, so it must not be 0. A larger value lets the other errors change too."""
MOVED = 0.05
"""The least change of a camera's rotation (rad) between the halves of a log that shows that the camera was moved. A larger
value warns less often."""
SIGMAS = 5.0
"""The least change of a moved camera's rotation, in standard deviations. The change must exceed this number of standard
deviations of the estimate, and of the jackknife. A larger number warns less often."""
_SUSPECT, _SUSPECT_SIGMAS = 0.5, 2.0
"""The least change for which another round of the estimation follows: as a multiple of `MOVED`, and in standard deviations.
In the first round, only rays that show a small change fit. Larger values take less time, and find fewer turns."""
_BLOCKS = 8
"""The number of pieces of time that are left out one at a time. All pieces have equally many boxes. A piece must be longer
than the time for which errors of poses last. More pieces are shorter, and take longer to compute."""
_MOVED_BY_ODOMETRY, _GAIN_BY_ODOMETRY = 0.1, 0.03
"""The value of `MOVED` (rad) for poses by odometry, and the least growth of the score (`Agreement.score`) by a turn at such
poses. Drift looks like a rotation of the camera, and the standard deviations do not contain drift. Larger values warn less
often."""


def check_moved_camera(part: Part, middle: float, settings: Settings) -> list[Finding]:
    """Return a finding for each rotation of a camera that differs between the halves of a log.

    middle: s, the stamp that ends the first half.
    """
    halves = _halves(part, middle)
    start = agreement(halves, halves.log, settings)
    if start is None:
        return []
    least, gain = (_MOVED_BY_ODOMETRY, _GAIN_BY_ODOMETRY) if part.drifts else (MOVED, 0.0)

    def suspect(found: Calibration) -> bool:
        return bool(turns(found, _SUSPECT * least, _SUSPECT_SIGMAS))

    apart, turned = without_usual_errors(halves, start, settings, one_rotation_each, suspect)
    moved = {} if turned is None else turns(turned, least, SIGMAS)
    if not moved:
        return []
    same, _ = without_usual_errors(halves, start, settings, partial(one_rotation_each, turn=0.0))
    if apart.score <= same.score + gain:
        return []
    assert turned is not None  # Without an estimate, there is no turn.
    spread = _spreads(halves, turned, settings)
    return finding_of_turns({name: turn for name, turn in moved.items() if abs(turn) > SIGMAS * spread[name]})


def finding_of_turns(moved: Mapping[str, float]) -> list[Finding]:
    """Return a finding for each turn, rad, of a camera between the halves of a log."""
    return [
        Finding(
            "camera moved",
            f"{name} changes by {np.degrees(change):.1f} deg between the halves of the log: "
            "somebody moved the camera on the robot",
            basis="halves",
        )
        for name, change in moved.items()
    ]


def in_halves(cameras: Sequence[CameraLog]) -> tuple[CameraLog, ...]:
    """Return two cameras for each camera: first all cameras of the first half, then all cameras of the second half.

    Each of them has the boxes of both halves.
    """
    later = [replace(one, camera=replace(one.camera, name=one.camera.name + _LATER)) for one in cameras]
    return (*cameras, *later)


def first_half(name: str) -> str:
    """Return the name of a shared error without the mark of the second half."""
    return name.replace(_LATER, "")


def _spreads(halves: Part, turned: Calibration, settings: Settings) -> dict[str, float]:
    """Return the standard deviation (rad) of each turn between the halves, by the jackknife.

    turned: the errors of the whole log. Each estimate starts from these errors, because fewer rays fit without them. If
    nothing can be estimated without a block, the block counts as no change.
    """
    stamps = [np.zeros(0) if one.detections is None else one.detections.frame_stamps for one in halves.log.cameras]
    every = np.sort(np.concatenate([one.detections.stamps for one in halves.log.cameras if one.detections is not None]))
    edges = np.append(every[np.arange(_BLOCKS) * len(every) // _BLOCKS], np.inf)
    values = dict(zip(turned.names, turned.values.tolist(), strict=True))
    changes = []
    for begin, end in pairwise(edges.tolist()):
        part = _take(halves, [(one < begin) | (one >= end) for one in stamps])
        start = agreement(part, take_out(part.log, values, stay=True), settings)
        if start is not None:
            _, found = without_usual_errors(part, start, settings, one_rotation_each, known=turned)
            changes.append(_changes(turned if found is None else found))
    off = {name: np.array([one.get(name, change) for one in changes]) for name, change in _changes(turned).items()}
    share = (_BLOCKS - 1) / _BLOCKS
    return {name: float(np.sqrt(share * len(one) * np.var(one))) if len(one) else np.inf for name, one in off.items()}


def _take(part: Part, kept: Sequence[Bools]) -> Part:
    """Return the part with some of the frames of each camera. kept: for each camera, which frames (F,) to take."""
    cameras = [
        one if one.detections is None else replace(one, detections=take_frames(one, mine))
        for one, mine in zip(part.log.cameras, kept, strict=True)
    ]
    windows = [window[mine] if len(mine) else window for window, mine in zip(part.window, kept, strict=True)]
    return replace(part, log=replace(part.log, cameras=tuple(cameras)), window=tuple(windows))


def _halves(part: Part, middle: float) -> Part:
    """Return the part with two cameras in place of each camera: one with the first half of its frames, and one with the
    rest.

    The halves have windows of their own, so each half has its own points.
    """
    cameras: list[CameraLog] = []
    windows: list[Ints] = []
    for one, window in zip(part.log.cameras, part.window, strict=True):
        stamps = np.zeros(0) if one.detections is None else one.detections.frame_stamps
        for late in (False, True):
            mine = (stamps > middle) == late
            camera = replace(one.camera, name=one.camera.name + late * _LATER)
            cameras.append(replace(one, camera=camera, detections=take_frames(one, mine) if len(stamps) else None))
            windows.append(window[mine] + late * (window.max(initial=0) + 1))
    return replace(part, log=replace(part.log, cameras=tuple(cameras)), window=tuple(windows))


def one_rotation_each(errors: SharedErrors, turn: float = _TURN) -> Floats:
    """Return a prior covariance (P, P) that lets only the rotations of a camera differ between the halves.

    errors: the shared errors of the cameras of two halves. turn: rad, the standard deviation of the difference. With 0, no
    error differs.
    """
    sigma = np.sqrt(np.diagonal(errors.prior))
    prior = np.diag(sigma**2)
    for i, j in _pairs(errors.names):
        change = turn if turn and kind(errors.names[i]) in _AXES else _SAME * sigma[i]
        prior[i, j] = prior[j, i] = sigma[i] ** 2
        prior[j, j] = sigma[i] ** 2 + change**2
    return prior


def _pairs(names: tuple[str, ...]) -> list[tuple[int, int]]:
    """Return pairs of indices: an error of the first half, and the same error of the second half."""
    split = [name.rpartition(".") for name in names]
    pairs = [(i, f"{camera}{_LATER}.{what}") for i, (camera, _, what) in enumerate(split)]
    return [(i, names.index(later)) for i, later in pairs if later in names]


def _changes(found: Calibration) -> dict[str, float]:
    """Return the change (rad) of each rotation of a camera between the halves, by the name of the error in the first
    half."""
    pairs = [(i, j) for i, j in _pairs(found.names) if kind(found.names[i]) in _AXES]
    return {found.names[i]: float(found.values[j] - found.values[i]) for i, j in pairs}


def turns(found: Calibration, least: float, sigmas: float) -> dict[str, float]:
    """Return the turns (rad) between the halves that are larger than `least` (rad) and larger than `sigmas` standard
    deviations."""
    turns, changes = {}, _changes(found)
    for i, j in _pairs(found.names):
        change, of = changes.get(found.names[i], 0.0), found.covariance
        sigma = float(np.sqrt(max(of[i, i] + of[j, j] - 2 * of[i, j], 0.0)))
        if abs(change) > max(least, sigmas * sigma):
            turns[found.names[i]] = change
    return turns
