"""Tests of the poses of a log: can a robot move in this way?"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import interpolate, inverse, lengths
from objslam.core.rotation import rotation_vector
from objslam.core.trajectory import Trajectory, usual_seconds
from objslam.core.types import Log
from objslam.frontend.localization.localization_jumps import (
    ACCELERATION,
    FEWEST_STEPS,
    STILL,
    TIMES_ODD,
    oddness,
    steps_of,
    unlike,
)
from objslam.frontend.odometry_restarts import counts_from_zero
from objslam.mapping.checks.finding import JUMPS, Finding
from objslam.mapping.checks.parts.moving_boxes import boxes_move

FASTEST = 40.0
"""The largest typical speed (m/s) of poses in metres. It is the speed of a car on a motorway. A larger speed warns less
often."""
_FASTEST_TURN = 8.0
"""Headings are not in radians if the moving robot exceeds this turn rate (rad/s) in a tenth of its steps. A larger rate
warns less often."""
_TURN_TIME = 0.1
"""The time (s) over which turn rates are measured. A longer time suits noisy headings, and hides short turns."""
_JUMP = 5.0
"""A step of an otherwise slow path may be a jump if its speed (m/s) is above this. It equals live.max_speed. A larger speed
warns less often."""
_JUMP_TURN = 20.0
"""A step of an otherwise slow path may be a jump if its turn rate (rad/s) is above this. As in a live session, it is 4 rad/s
for each m/s of live.max_speed. A larger rate warns less often."""
_JUMP_WAY, _JUMP_ANGLE = 0.3, 0.3
"""The least distance (m) and turn (rad) of a jump. Larger values ignore small corrections."""
_TIMES = 5.0
"""The least speed of a jump, as a multiple of the speed that the moving robot exceeds in a tenth of its steps. It is also
the multiple for the turn rate of a jump. A larger number warns less often."""
_FROZEN_SECONDS = 8.0
"""The shortest time (s) without motion that may be a frozen path. If a robot really stands still, its boxes do not move in
the image either. A larger value finds fewer frozen paths."""
_LEAST_STEP = 0.01
"""The noise (m) of a position. The direction of a motion is judged if the motion is longer than three times this noise. A
larger value suits noisy poses."""
_PIECE = 1.0
"""The time (s) between two stamps at which distances are compared. A longer time is faster and less exact."""
_PIECES = (1, 4, 16)
"""Distances are compared over these numbers of pieces (`_PIECE`). A wrong scale shows over each number. Noise of positions,
such as that of satellite positioning, lengthens only short distances. Larger numbers suit noisier positions and longer
logs."""
_LEAST_PIECE = 0.3
"""Two distances are compared if both are at least this share of the longest distance in the same time. Shorter distances are
noise. A larger share compares fewer distances."""
_OTHER_SCALE = 0.1
"""A run warns if the logarithm of the ratio between the distances by localisation and odometry exceeds this. Real odometry
errs by up to 8 %. A larger value warns less often."""
_BEFORE = 0.3
"""The time (s) over which the direction of motion is measured. A longer time suits noisy poses and slow turns."""


def check_path(log: Log, settings: Settings) -> list[Finding]:
    """Return the findings about the poses of a log, from the poses and from the motion of the boxes.

    In fixed mode with a localisation, the odometry is not used. So its speed and its jumps do not spoil the map.
    """
    max_gap, joint = settings.poses.max_gap, settings.mode == "joint"
    found: list[Finding] = []
    for name, path in (("localisation", log.localization), ("odometry", log.odometry)):
        if path is not None and len(path) > FEWEST_STEPS:
            used = joint or path is log.robot_path
            found += (one if used else replace(one, spoils=False) for one in _judge_speed(path, name))
            found += _judge_stops(path, name, log)
    if log.odometry is not None and (joint or log.localization is None):
        found += _find_restarts(log.odometry, max_gap)
    if log.localization is not None and log.odometry is not None:
        found += _compare_ways(log.localization, log.odometry)
        if not any(one.name.endswith("jumps") for one in found):
            found += _compare_steps(log.localization, log.odometry, max_gap)
    return found


def _find_restarts(odometry: Trajectory, max_gap: float) -> Iterator[Finding]:
    """Yield a finding if the odometry counts from zero again after a gap. max_gap: s, the longest time that is no gap."""
    seconds = np.diff(odometry.stamps)
    gaps = np.flatnonzero(seconds > max_gap)
    restarts = gaps[counts_from_zero(odometry.poses[gaps], odometry.poses[gaps + 1])]
    if len(restarts):
        first = int(restarts[0])
        yield Finding(
            "odometry restarts",
            f"the odometry counts from zero again after a gap of {seconds[first]:.1f} s, at stamp "
            f"{odometry.stamps[first + 1]:.3f}{_and_more(len(restarts) - 1)}: poses before and after it do not belong "
            "together; map both parts of the log (--end, --begin), and join them with objslam merge",
        )


def _and_more(count: int) -> str:
    return f" and {count} more time{'' if count == 1 else 's'}" if count else ""


def _compare_steps(localization: Trajectory, odometry: Trajectory, max_gap: float) -> Iterator[Finding]:
    """Yield a finding if the localisation has steps that the odometry does not show."""
    wheels, known = interpolate(odometry.stamps, odometry.poses, localization.stamps, max_gap)
    pair = np.flatnonzero(known[:-1] & known[1:] & (np.diff(localization.stamps) <= max_gap))
    if len(pair) < FEWEST_STEPS:
        return
    relative = [inverse(poses[pair]) @ poses[pair + 1] for poses in (localization.poses, wheels)]
    by_map, by_wheels = (np.stack([one[:, :3, 3], rotation_vector(one[:, :3, :3])], axis=1) for one in relative)
    way = lengths(by_map[:, 0] - by_wheels[:, 0])
    # A step that only the odometry makes is an error of the odometry, such as a slip.
    own = (unlike(by_map) > unlike(by_wheels)).any(axis=1)
    angle = lengths(rotation_vector(np.swapaxes(relative[1][:, :3, :3], 1, 2) @ relative[0][:, :3, :3]))
    jumps = (way > max(_JUMP_WAY, TIMES_ODD * float(np.quantile(way, 0.9)))) | (
        angle > max(_JUMP_ANGLE, TIMES_ODD * float(np.quantile(angle, 0.9)))
    )
    jumps &= own
    if jumps.any():
        first = int(np.argmax(jumps))
        yield Finding(
            JUMPS,
            f"the localisation moves by {way[first]:.2f} m and {np.degrees(angle[first]):.0f} deg in one step which the "
            f"odometry does not show, at stamp {localization.stamps[pair[first] + 1]:.3f}"
            f"{_and_more(int(jumps.sum()) - 1)}: poses before and after a jump do not belong together",
            spoils=log_is_split(way, jumps),
        )


def _compare_ways(localization: Trajectory, odometry: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the localisation and the odometry measure different distances in the same pieces of time."""
    begin, end = max(localization.stamps[0], odometry.stamps[0]), min(localization.stamps[-1], odometry.stamps[-1])
    times = np.arange(begin, end, _PIECE)
    if len(times) < FEWEST_STEPS:
        return
    by_map, by_wheels = (
        interpolate(path.stamps, path.poses, times, np.inf)[0][:, :3, 3] for path in (localization, odometry)
    )
    ratios = [_log_ratio(by_map, by_wheels, pieces) for pieces in _PIECES]
    found = [one for one in ratios if one is not None]
    middle, limit = min(found, key=lambda one: abs(one[0]) - one[1], default=(0.0, np.inf))
    if abs(middle) > limit:
        yield Finding(
            "scales differ",
            f"the localisation goes {np.exp(middle):.3g} times as far as the odometry: one of them is not in metres, or has "
            "a wrong scale",
        )


def _log_ratio(by_map: Floats, by_wheels: Floats, pieces: int) -> tuple[float, float] | None:
    """Return the logarithm of a ratio of distances, and the largest logarithm that errors may cause.

    The distances are between places (n, 3), in m, that are `pieces` rows apart. The ratio is by_map to by_wheels. None if
    there are too few distances.
    """
    far = [np.linalg.norm(places[pieces:] - places[:-pieces], axis=1) for places in (by_map, by_wheels)]
    if len(far[0]) < FEWEST_STEPS:
        return None
    moved = np.minimum(*far) > _LEAST_PIECE * np.maximum(*far).max()
    if moved.sum() < FEWEST_STEPS:
        return None
    ratio = np.log(far[0][moved] / far[1][moved])
    middle = float(np.median(ratio))
    sigma = 1.5 * float(np.median(np.abs(ratio - middle))) * np.sqrt(pieces / moved.sum())  # Distances overlap.
    return middle, max(_OTHER_SCALE, 5 * sigma)


def _judge_speed(path: Trajectory, name: str) -> Iterator[Finding]:
    seconds = usual_seconds(np.diff(path.stamps))
    way, angle = lengths(steps_of(path.poses)).T
    moving = (way > STILL) | (angle > STILL)
    if moving.sum() < FEWEST_STEPS:
        return
    speed, rate = way / seconds, angle / seconds
    usual, turning = float(np.median(speed[moving])), float(np.quantile(_turn_rates(path)[moving], 0.9))
    if usual > FASTEST:
        unit = "the positions are probably in mm instead of m" if usual < 1e4 else "the stamps are probably not in s"
        yield Finding(
            f"{name} too fast",
            f"the {name} moves at {usual:.0f} m/s, which no robot does: {unit}",
        )
        return
    if turning > _FASTEST_TURN:
        yield Finding(
            f"{name} turns too fast",
            f"the {name} turns at {turning:.0f} rad/s, as no robot does: the yaw is probably in degrees instead of rad",
        )
        return
    fast = float(np.quantile(speed[moving], 0.9)), float(np.quantile(rate[moving], 0.9))
    # A gap in the poses is no jump. The speed over the gap is one that a robot can reach.
    jumps = (speed > max(_JUMP, _TIMES * fast[0])) & (way > _JUMP_WAY)
    jumps |= (rate > max(_JUMP_TURN, _TIMES * fast[1])) & (angle > _JUMP_ANGLE)
    odd = oddness(path)[:, 0]
    jumps |= _pulses(path, odd, moving)
    if jumps.any():
        first = int(np.argmax(jumps))
        yield Finding(
            f"{name} jumps",
            f"the {name} jumps {jumps.sum()} time{'' if jumps.sum() == 1 else 's'} (first by {odd[first]:.2f} m and "
            f"{np.degrees(angle[first]):.0f} deg at stamp {path.stamps[first + 1]:.3f}): "
            "poses before and after a jump do not belong together"
            + ("; map both parts of the log (--end, --begin)" if name == "odometry" and jumps.sum() == 1 else ""),
            spoils=name == "odometry" or log_is_split(odd, jumps),
        )


def _pulses(path: Trajectory, odd: Floats, moving: Bools) -> Bools:
    """Return which steps (N-1,) differ from both steps beside them by more than a robot can accelerate and brake.

    Some localisations repeat each pose until the next one is known. odd: (N-1,) m, the `oddness` of the moves. moving:
    (N-1,) the steps in which the robot moves. They show what is usual.
    """
    seconds = np.diff(path.stamps)
    off = np.where(seconds <= 2 * np.median(seconds), odd, 0.0)  # In a gap of the poses, a robot can do anything.
    least = np.maximum(_JUMP_WAY + ACCELERATION * seconds**2, TIMES_ODD * np.quantile(off[moving], 0.9))
    return np.asarray(off > least)


def log_is_split(way: Floats, jumps: Bools) -> bool:
    """Return whether a localisation jumps by more than 1 m, as if it changed to another map. A shorter jump is a correction.

    way: (N-1,) m, the excess length of each step. The whole length would not do, because a fast robot drives more than 1 m
    in a step. jumps: (N-1,) which steps are jumps.
    """
    return bool(jumps.any() and way[jumps].max() > 1.0)


def _judge_stops(path: Trajectory, name: str, log: Log) -> Iterator[Finding]:
    """Yield a finding if the poses stand still for a long time while the boxes move."""
    way, angle = lengths(steps_of(path.poses)).T
    still = (way < STILL) & (angle < STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    frozen, begin = 0.0, None
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        start, end = float(path.stamps[first]), float(path.stamps[last])
        if end - start >= _FROZEN_SECONDS and boxes_move(log, start, end):
            begin = start if begin is None else begin
            frozen += end - start
    if begin is not None:
        whole = float(path.stamps[-1] - path.stamps[0])
        yield Finding(
            f"{name} frozen",
            f"the {name} stands still for {frozen:.0f} of {whole:.0f} s while the boxes move (from stamp {begin:.3f}): "
            "the poses are probably frozen",
        )


def _turn_rates(path: Trajectory) -> Floats:
    """Return the turn rate (N-1,), rad/s, from each pose except the last one. It is a mean over at least `_TURN_TIME`.

    The turns are added as vectors, so the noise of headings averages out.
    """
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps_of(path.poses)[:, 1], axis=0)])
    first = np.arange(len(path) - 1)
    last = np.clip(np.searchsorted(path.stamps, path.stamps[:-1] + _TURN_TIME), first + 1, len(path) - 1)
    turn, seconds = turned[last] - turned[first], path.stamps[last] - path.stamps[first]
    return np.asarray(np.linalg.norm(turn, axis=1) / seconds)


def straightness(path: Trajectory) -> float | None:
    """Return how constant the direction of motion is in the robot's base: 1 for wheels, near 0 for poses with wrong axes.

    The value is the length of the mean direction of motion in base. Motions that are too short have no direction and do not
    count. None if too few motions count, or if the robot hardly turns. All axes fit a robot that does not turn.
    """
    if len(path) < FEWEST_STEPS:
        return None
    later = np.searchsorted(path.stamps, path.stamps + _BEFORE)
    first = np.flatnonzero(later < len(path))
    last = later[first]
    way = path.poses[last, :3, 3] - path.poses[first, :3, 3]
    length = np.linalg.norm(way, axis=1)
    near = path.stamps[last] - path.stamps[first] < 4 * _BEFORE
    noise = float(np.median(length[near])) if near.any() else 0.0
    kept = near & (length > max(3 * _LEAST_STEP, noise / 2))
    if kept.sum() < FEWEST_STEPS:
        return None
    first, last, direction = first[kept], last[kept], way[kept] / length[kept, None]
    if np.linalg.norm(direction.mean(axis=0)) > 0.9:
        return None
    # To first order, the axes of base between two poses are the mean of the axes at both poses.
    middle = path.poses[first, :3, :3] + path.poses[last, :3, :3]
    in_base = np.einsum("nji,nj->ni", middle, direction)
    size = np.linalg.norm(in_base, axis=1, keepdims=True)
    in_base = in_base / np.maximum(size, 1e-9)
    return float(np.linalg.norm(in_base.mean(axis=0)))
