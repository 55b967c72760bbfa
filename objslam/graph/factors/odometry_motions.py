"""The motions by odometry that a graph gets: from keyframe to keyframe, and across the steps of a slow odometry.

Between two poses of the odometry, a keyframe has an interpolated pose. The errors of the motions inside such a step are not
independent, because the odometry measures the whole step. A robot that turned late in one motion turned more in the next
motion. So the motions inside a step get the loose noise of a random walk, and a tie across the step measures their sum. For
a linear system this is exact. Let d be the shares of a step that its motions cover. Let D be the noise of the step by the
odometry, and W the noise of a random walk over the step. The noise of the motions is D diag(d), plus the noise
W (diag(d) - d d') of a bridge. The information of the motions is then a sum of two parts. Independent motions with the noise
(D + W) d have the first part. A tie has the second part, 1 / D - 1 / (D + W).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse
from objslam.core.types import Keyframes
from objslam.graph.factors.odometry import motions, wander

_LEAST_TOLD = 0.1
"""The least share of the information about a motion that a tie must give in some direction. Other ties are not used. With a
larger share, fewer ties are used, and the motions without a tie count as independent. With a smaller share, faster odometry
also gets ties. Such ties hardly change the solution, but take time."""
_NOTHING = 1e-6
"""The least share of the information about a motion that a tie gets in each direction. A tie has no information in
directions in which the motions inside a step are not loose. With this share, the information matrix of a tie still has an
inverse. A larger share adds more false information in these directions."""


@dataclass(frozen=True)
class OdometryMotions:
    """M camera motions: first the motions between consecutive keyframes, then the ties. The motions below a tie are the
    motions between its two keyframes.

    before, after: (M,) the keyframes. motion: (M, 4, 4). noise: (M, 6, 6) the covariances of the odometry. wander:
    (M, 6, 6) the covariances of the interpolated path, which add to the noise. loose: (T, 6, 6) for each of the T ties, the
    wander of the independent motions below the tie.
    """

    before: Ints
    after: Ints
    motion: Floats
    noise: Floats
    wander: Floats
    loose: Floats

    @classmethod
    def of(cls, keyframes: Keyframes, settings: Settings, ties: Ints) -> Self:
        """Return the motions of keyframes with odometry. ties: (T, 2) from `find_ties`."""
        chain = np.flatnonzero(keyframes.measured)
        before, after = np.concatenate([chain, ties[:, 0]]), np.concatenate([chain + 1, ties[:, 1]])
        motion, noise = motions(replace(keyframes, wander=None), settings, pairs=(before, after))
        below = below_ties(ties, len(keyframes))
        bridge = wander(keyframes, before, after)
        here = np.flatnonzero(below[chain])
        walk = np.zeros((len(keyframes), 6, 6))
        walk[chain[here] + 1] = bridge[here] = wander(keyframes, chain[here], chain[here] + 1, walk=True)
        total = np.cumsum(walk, axis=0)
        bridge = _in_camera(keyframes, after, bridge)
        loose = _in_camera(keyframes, ties[:, 1], total[ties[:, 1]] - total[ties[:, 0]])
        return cls(before, after, motion, noise, bridge, loose)

    def __len__(self) -> int:
        return len(self.before)

    @property
    def tied(self) -> float:
        """The share of the motions between consecutive keyframes that are below ties."""
        chain = len(self) - len(self.loose)
        return float((self.after[chain:] - self.before[chain:]).sum()) / max(chain, 1)

    def noise_of(self, keyframes: Keyframes, settings: Settings) -> Floats:
        """Return the noise (M, 6, 6) that the same motions have with these keyframes and settings."""
        return motions(replace(keyframes, wander=None), settings, pairs=(self.before, self.after))[1]

    def with_noise(self, noise: Floats) -> Self:
        """Return the motions with another noise (M, 6, 6) of the odometry."""
        return replace(self, noise=noise)

    @cached_property
    def covariance(self) -> Floats:
        """(M, 6, 6) the covariances of the motions. That of a tie is the inverse of the information that the tie adds."""
        covariance = self.noise + self.wander
        ties = slice(len(self) - len(self.loose), len(self))
        if len(self.loose):
            covariance[ties] = _remaining(covariance[ties], self.noise[ties] + self.loose)
        return covariance


def _in_camera(keyframes: Keyframes, last: Ints, covariance: Floats) -> Floats:
    """Move covariances (M, 6, 6) from the frame of odom_T_base into the frames of the keyframes `last` (M,)."""
    if not covariance.any():
        return covariance
    assert keyframes.odom_T_base is not None
    to_camera = adjoint(inverse(keyframes.odom_T_base[last] @ keyframes.base_T_camera[last]))
    moved = to_camera @ covariance @ np.swapaxes(to_camera, -1, -2)
    return np.asarray((moved + np.swapaxes(moved, -1, -2)) / 2)


def below_ties(ties: Ints, count: int) -> Bools:
    """Return which motions (count - 1,) between consecutive keyframes are below one of the ties (T, 2)."""
    ends = np.zeros(count, dtype=np.int64)
    np.add.at(ends, ties[:, 0], 1)
    np.add.at(ends, ties[:, 1], -1)
    return np.cumsum(ends)[:-1] > 0


def find_ties(keyframes: Keyframes, settings: Settings) -> Ints:
    """Return the pairs (T, 2) of keyframes that need a tie, one after the other along the path.

    A tie connects the keyframes that are nearest to two poses of the odometry, if other keyframes lie between the two. A
    tie is left out if it adds too little information (`_LEAST_TOLD`), because the interpolation errs little.
    """
    nothing = np.zeros((0, 2), dtype=np.int64)
    if keyframes.step is None or keyframes.wander is None or len(keyframes) < 3:
        return nothing
    pose = np.rint(keyframes.step).astype(np.int64)
    nearest = np.lexsort((np.abs(keyframes.step - pose), pose))
    nearest = np.sort(nearest[np.unique(pose[nearest], return_index=True)[1]])
    pairs = np.column_stack([nearest[:-1], nearest[1:]])
    unmeasured = np.append(0, np.cumsum(~keyframes.measured))
    pairs = pairs[(np.diff(pairs, axis=1)[:, 0] > 1) & (unmeasured[pairs[:, 0]] == unmeasured[pairs[:, 1]])]
    if not len(pairs):
        return nothing
    found = OdometryMotions.of(keyframes, settings, pairs)
    noise = found.noise[-len(pairs) :]
    told = _told(noise + found.wander[-len(pairs) :], noise + found.loose)[0]
    return np.asarray(pairs[told.max(axis=1) >= _LEAST_TOLD])


def _told(whole: Floats, loose: Floats) -> tuple[Floats, Floats]:
    """Return the share (T, 6) of the information of `whole` that `loose` does not have, along each of six axes. Also return
    the axes (T, 6, 6). whole, loose: (T, 6, 6) covariances."""
    root = np.linalg.cholesky(whole)
    back = np.linalg.inv(root)
    size, axes = np.linalg.eigh(back @ loose @ np.swapaxes(back, 1, 2))
    return 1 - 1 / np.maximum(size, 1.0), root @ axes


def _remaining(whole: Floats, loose: Floats) -> Floats:
    """Return the covariance (T, 6, 6) whose information, added to that of `loose`, gives the information of `whole`."""
    told, axes = _told(whole, loose)
    return (axes / np.maximum(told, _NOTHING)[:, None]) @ np.swapaxes(axes, 1, 2)
