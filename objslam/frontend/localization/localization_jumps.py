"""Jumps of a localisation: steps that no robot makes, or that the odometry does not show.

A particle filter jumps when it corrects an earlier mistake, or when it takes another place for the robot's place. Then the
poses on one side of the jump are wrong by the whole jump. Objects seen from both sides would be at two places, and a
calibration would take a part of the jump for an error of a sensor. The path itself shows how large the jump is. It does not
show which side is right.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import interpolate, is_planar, lengths
from objslam.core.rotation import cross, rotation_from_vector, rotation_vector
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.core.trajectory import Trajectory, usual_seconds
from objslam.core.types import Log

ANOTHER_MAP = 1.0
"""The longest jump (m) that is corrected. Before a longer jump, the localisation may have changed to another map, or
somebody may have carried the robot. A larger value corrects longer jumps."""
ACCELERATION = 5.0
"""The highest acceleration (m/s^2) of a robot from one step to the next and back. Wheels on a floor slip at 4 to 8 m/s^2.
With a larger value, fewer steps are jumps."""
_FREE_ACCELERATION = 20.0
"""The highest acceleration (m/s^2) of poses that are not in a plane. Cameras in a hand and drones reach 2 g. With a larger
value, fewer steps are jumps."""
TIMES_ODD = 3.5
"""The least oddness of a jump, as a multiple of the oddness that a tenth of the steps exceeds. The oddness of a step is its
difference from the steps beside it, or from the step of the odometry. For normal noise in a plane, 3.5 is 7.5 standard
deviations. A larger number finds fewer jumps."""
_CERTAIN = float(np.sqrt(27.6))
"""The least size of a jump, in standard deviations. This standard deviation is that of two poses and of the odometry between
them, by the settings. Noise exceeds this size with a probability of 1e-6 (chi-squared, 2 degrees of freedom). This is once
in a thousand logs of a thousand poses. A smaller jump counts as noise. A larger number finds fewer jumps."""
_OF_MEDIAN = float(np.sqrt(np.log(10) / np.log(2)))
"""The length that a tenth of the steps exceeds for normal noise in a plane, as a multiple of the median length."""
FEWEST_STEPS = 20
"""The fewest steps of a path that are judged. Fewer steps do not show what is usual."""
_MOST_JUMPS = 10
"""The most jumps of a log. A localisation that jumps more often is a noisy one, and its noise is estimated. A larger number
corrects worse localisations."""
STILL = 1e-4
"""The distance (m) and the turn (rad) below which two poses are one pose that was repeated. A larger value takes slow motion
for a stop."""


@dataclass(frozen=True)
class Jumps:
    """J jumps of a localisation.

    stamps: (J,) s, of the first pose after each jump. moves: (J, 3) m in map, and turns: (J, 3) rad, a rotation vector in
    map: by how much the path jumps. noise: (2, 3) the standard deviations of the coordinates of a move, m, and of a turn,
    rad. shares: (J + 1,) the share of each part in the time of the path. The parts lie between the jumps.
    """

    stamps: Floats
    moves: Floats
    turns: Floats
    noise: Floats
    shares: Floats

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def offsets(self) -> Floats:
        """(J + 1, 3) m, the place of each part of the path relative to its first part."""
        return np.concatenate([np.zeros((1, 3)), np.cumsum(self.moves, axis=0)])

    @property
    def rotations(self) -> Floats:
        """(J + 1, 3, 3) the rotation of each part of the path relative to its first part."""
        found = [np.eye(3)]
        for turn in rotation_from_vector(self.turns):
            found.append(turn @ found[-1])
        return np.stack(found)

    @property
    def middle(self) -> tuple[Floats, Floats]:
        """The mean of `offsets` (3,) and of `rotations` (3, 3) over the time of the path."""
        turns = rotation_vector(self.rotations)
        return self.shares @ self.offsets, rotation_from_vector(self.shares @ turns)

    @property
    def likely(self) -> Floats:
        """(J + 1,) the probability that each part is right, proportional to the root of its share of the time.

        This probability lies between two assumptions. If a localisation were right at a random moment, a short part would
        hardly ever be right. If each part were right with the same probability, a single wrong pose between two right parts
        would be right with probability 1/3.
        """
        found = np.sqrt(self.shares)
        return found / found.sum()

    @property
    def sigma(self) -> float:
        """The root mean square of the distance, m, between the mean place and the place of the right part."""
        return float(np.sqrt(self.likely @ ((self.offsets - self.middle[0]) ** 2).sum(axis=1)))

    def part(self, stamps: Floats) -> Ints:
        """Return the part (Q,) of the path at stamps (Q,), s."""
        return np.searchsorted(self.stamps, stamps, side="right")

    def taken_out(self, path: Trajectory) -> Trajectory:
        """Return the path without its jumps. The mean of its places does not change. Each pose turns about its own place."""
        part, (place, rotation) = self.part(path.stamps), self.middle
        poses = path.poses.copy()
        poses[:, :3, 3] -= (self.offsets - place)[part]
        poses[:, :3, :3] = (rotation @ np.swapaxes(self.rotations, 1, 2))[part] @ poses[:, :3, :3]
        return replace(path, poses=poses)

    def spread(self, stamps: Floats, origins: Floats, owner: Ints, positions: Floats) -> Floats:
        """Return the errors that the jumps cause in the objects, as a factor (N, 3, m), m, of their joint covariance. The
        errors have two causes. First, the right part is unknown. With the probability `likely` of a part, this part is
        right, and all objects are off by its offset from the mean. Second, the size of each jump has noise. This noise moves
        an object in proportion to the share of its rays beyond the jump.

        stamps: (R,) s, origins: (R, 3) m, owner: (R,) the object of each ray. positions: (N, 3) m of the objects.
        """
        count, part, (place, rotation) = len(positions), self.part(stamps), self.middle
        seen = np.maximum(np.bincount(owner, minlength=count), 1)
        centre = np.stack([np.bincount(owner, origins[:, k], count) for k in range(3)], axis=1) / seen[:, None]
        turned = self.rotations @ rotation.T - np.eye(3)
        shift = (self.offsets - place)[:, None] + np.einsum("kij,nj->kni", turned, positions - centre)
        found = [np.sqrt(chance) * one for chance, one in zip(self.likely, shift, strict=True)]
        for number in range(len(self)):
            beyond = np.bincount(owner, part > number, count) / seen - self.shares[number + 1 :].sum()
            found += [beyond[:, None] * axis for axis in np.diag(self.noise[0])]
            found += [beyond[:, None] * cross(axis, positions - centre) for axis in np.diag(self.noise[1])]
        return np.stack(found, axis=2)


def find_jumps(log: Log, settings: Settings) -> Jumps | None:
    """Return the jumps of the localisation that can be corrected, None if there are none.

    The odometry shows the true steps if the log has it. Without it, a step is judged by the steps beside it. If there are
    too many jumps, or if one is longer than `ANOTHER_MAP`, none can be corrected.
    """
    path = log.localization
    if path is None or settings.poses.jumps == "keep" or len(path) <= FEWEST_STEPS:
        return None
    # Some localisations repeat each pose until the next one is known. No step took less time than the repetitions.
    moved = lengths(steps_of(path.poses)) > STILL
    new = np.append(True, moved.any(axis=1))
    path = replace(path, stamps=path.stamps[new], poses=path.poses[new])
    if len(path) <= FEWEST_STEPS:
        return None
    if log.odometry is None:
        odd, off, judged = _by_neighbours(path)
    else:
        odd, off, judged = _by_odometry(path, log.odometry, settings.poses.max_gap)
    if judged.sum() < FEWEST_STEPS:
        return None
    # Each pair is a distance and an angle.
    drift = 0.0 if log.odometry is None else _drift(lengths(steps_of(path.poses)), settings)
    poses = 2 * np.array([settings.localization.xy, settings.localization.yaw]) ** 2
    usual = TIMES_ODD * np.quantile(off[judged], 0.9, axis=0)
    least = np.maximum(np.maximum(usual, _usual_corrections(off[judged], usual)), _CERTAIN * np.sqrt(poses + drift))
    # A turn alone is no jump: a hand turns a camera as fast, and wheels that slip do not show a turn.
    most = ACCELERATION if is_planar(path.poses) else _FREE_ACCELERATION
    possible = 0.0 if log.odometry is not None else most * np.diff(path.stamps) ** 2
    jumps = off[:, 0] > np.maximum(least[..., 0], possible)
    found = np.flatnonzero(jumps & judged)
    noise = np.median(np.abs(odd[judged]), axis=0) / NORMAL_MEDIAN
    if not len(found) or len(found) > _MOST_JUMPS or lengths(odd[found])[:, 0].max() > ANOTHER_MAP:
        return None
    stamps = path.stamps[found + 1]
    ends = np.concatenate([path.stamps[:1], stamps, path.stamps[-1:]])
    return Jumps(stamps, odd[found, 0], odd[found, 1], noise, np.diff(ends) / (ends[-1] - ends[0]))


def _usual_corrections(off: Floats, usual: Floats) -> Floats:
    """Return the distance, m, and the turn, rad, up to which corrections of a localisation are usual.

    A particle filter follows the odometry, and corrects itself every few seconds. Most steps are then no corrections, so
    their oddness does not show how large corrections are. The largest of many corrections are not wrong, and without them
    the path drifts as the odometry does. So a jump must also stand out from the corrections. If there are few corrections,
    all of them may be jumps, and the result is 0.

    off: (N, 2) the oddness of steps, m and rad. usual: (2,) m and rad, the oddness up to which a step is no correction.
    """
    corrections = off[off[:, 0] > usual[0]]
    if len(corrections) <= _MOST_JUMPS:
        return np.zeros(2)
    return TIMES_ODD * _OF_MEDIAN * np.median(corrections, axis=0)


def _by_neighbours(path: Trajectory) -> tuple[Floats, Floats, Bools]:
    """Judge each step of a path by the steps beside it.

    Returns the differences (N-1, 2, 3) between each step and a step at the median velocity of four steps, the two before it
    and the two after it. Also returns the `oddness` (N-1, 2) of each step, and which steps (N-1,) are judged. In the axis of
    length 2, the first entry is the move, m, and the second is the turn, rad.
    """
    seconds = np.diff(path.stamps)
    velocity = steps_of(path.poses) / seconds[:, None, None]
    around = np.clip(np.arange(len(velocity))[:, None] + [-2, -1, 1, 2], 0, len(velocity) - 1)
    odd = (velocity - np.median(velocity[around], axis=1)) * seconds[:, None, None]
    judged = seconds <= 2 * np.median(seconds)  # In a gap of the poses, a robot can do anything.
    return odd, oddness(path), judged


def _by_odometry(path: Trajectory, odometry: Trajectory, max_gap: float) -> tuple[Floats, Floats, Bools]:
    """Judge each step of a path by the odometry. Returns the same as `_by_neighbours`.

    A step that only the odometry makes is an error of the odometry, such as a slip, and not odd.
    """
    wheels, known = interpolate(odometry.stamps, odometry.poses, path.stamps, max_gap)
    seconds = np.diff(path.stamps)
    by_map, by_wheels = steps_of(path.poses), steps_of(wheels)
    to_map = (path.poses[:, :3, :3] @ np.swapaxes(wheels[:, :3, :3], 1, 2))[:-1]
    odd = by_map - np.einsum("nij,nkj->nki", to_map, by_wheels)
    own = unlike(by_map / seconds[:, None, None]) > unlike(by_wheels / seconds[:, None, None])
    return odd, np.where(own, lengths(odd), 0.0), known[:-1] & known[1:] & (seconds <= max_gap)


def oddness(path: Trajectory) -> Floats:
    """Return the oddness (N-1, 2) of the steps of a path, m and rad. It is the difference from the more similar of the two
    neighbouring steps.

    The difference is computed twice: with the times of the steps as given, and with times that are not shorter than usual
    (`usual_seconds`). The smaller difference counts.
    """
    seconds, steps = np.diff(path.stamps), steps_of(path.poses)
    return np.asarray(
        np.min([unlike(steps / t[:, None, None]) * t[:, None] for t in (seconds, usual_seconds(seconds))], axis=0)
    )


def unlike(steps: Floats) -> Floats:
    """Return how far (N, 2) the moves and turns of steps (N, 2, 3) are from the more similar of their two neighbours. The
    first and the last step give 0, because they have only one neighbour."""
    change, none = lengths(np.diff(steps, axis=0)), np.full((1, 2), np.inf)
    found = np.minimum(np.concatenate([change, none]), np.concatenate([none, change]))
    found[[0, -1]] = 0.0
    return np.asarray(found)


def _drift(travel: Floats, settings: Settings) -> Floats:
    """Return the variances (N, 2) of the odometry over steps: of moves, m^2, and turns, rad^2. travel: (N, 2) m, rad."""
    of = settings.odometry
    along, across, turned = of.x_per_m**2, of.y_per_m**2, of.xy_per_rad**2
    per_length = np.array([[max(along, across), of.yaw_per_m**2], [turned, of.yaw_per_rad**2]])
    return np.asarray(travel @ per_length)


def steps_of(poses: Floats) -> Floats:
    """Return the move, m, and the turn as a rotation vector, rad, of each step of a path, both in map: (N-1, 2, 3)."""
    rotation = poses[:, :3, :3]
    turns = rotation_vector(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))
    return np.stack([np.diff(poses[:, :3, 3], axis=0), turns], axis=1)
