"""How far a robot may be from its interpolated path, between two poses of its odometry.

The interpolation assumes a constant velocity from pose to pose. A real robot changes its velocity between two poses, so it
is on the interpolated path only at the poses. The error of the interpolated path is called a bridge. At the share s of a
step, a random walk that is held at both ends has the variance `wander` * s * (1 - s). The changes of velocity from one step
to the next show how large `wander` is.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, log_se3
from objslam.core.trajectory import Trajectory, usual_seconds
from objslam.frontend.recent_values import ValuesOfObjects

_SHARED = 1.0
"""The weight of the mean change of velocity of the whole path in the estimate for one step. A change of velocity at an end
of the step has the weight 1. With a larger number, all steps wander more alike. With 0, a robot would never turn inside a
step whose neighbours have its velocity. On simulated drives, the largest error was six standard deviations with 0, and four
with 1."""


@dataclass(frozen=True)
class OdometryBridge:
    """The variance of the interpolated path of an odometry with N poses.

    stamps: (N,) s. wander: (N-1, 6) the `wander` of each step, for a twist of base with the rotation first.
    """

    stamps: Floats
    wander: Floats

    @classmethod
    def of(cls, odometry: Trajectory) -> Self:
        """Estimate the variance from the velocities in the steps of an odometry.

        Two neighbouring steps of T and U seconds have different mean velocities. If the velocity is white noise of density
        q, their difference has the variance q (1 / T + 1 / U), and the path wanders by q T. If the velocity is a random walk
        of density p, the variances are p (T + U) / 3 and p T^3 s^2 (1 - s)^2 / 3. Over a step, this second variance has the
        same mean as p T^3 / 15 * s (1 - s), which replaces it here. Between a step and the next but one, white noise gives
        the same variance as between neighbours, and a random walk gives 2.5 times as much. This shows, for each axis, which
        share of the changes is a random walk.

        Messages that had to wait arrive together. If they are stamped at arrival, their steps seem to take almost no time,
        and their velocities mean nothing. So each change is also computed as if no step were shorter than usual, and the
        smaller of the two changes counts.
        """
        seconds = np.diff(odometry.stamps)[:, None]
        step = log_se3(inverse(odometry.poses[:-1]) @ odometry.poses[1:])
        if len(step) < 2:
            return cls(odometry.stamps, np.zeros_like(step))
        given, spread = (_densities(step, time) for time in (seconds, usual_seconds(seconds)))
        once, twice, white, walked = (np.minimum(*pair) for pair in zip(given, spread, strict=True))
        walk = np.clip((twice.mean(axis=0) / once.mean(axis=0).clip(1e-300) - 1) / 1.5, 0.0, 1.0)
        return cls(odometry.stamps, (1 - walk) * _beside(white) * seconds + walk * _beside(walked) * seconds**3 / 15)

    def at(self, stamps: Floats) -> tuple[Floats, Floats]:
        """Return the places of stamps (K,), s, among the steps, and the variance (K, 6) of the step at each place.

        A place is the number of whole steps before the stamp, plus the share of the step in which the stamp lies. A stamp
        beyond an end of the path counts as that end.
        """
        last = len(self.stamps) - 1
        step = np.interp(stamps, self.stamps, np.arange(last + 1.0))
        if last == 0:
            return step, np.zeros((len(step), 6))
        return step, self.wander[np.minimum(step.astype(np.int64), last - 1)]


bridge_of = ValuesOfObjects[Trajectory, OdometryBridge](OdometryBridge.of)
"""`OdometryBridge.of` with kept results, because several steps of a run need it for the same odometry."""


def _densities(step: Floats, seconds: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the squared changes of velocity from a step to the next (n-1, 6) and to the next but one (n-2, 6). Also return
    two noise densities (n-1, 6) that the changes to the next step show: one if the velocity is white noise, and one if it is
    a random walk.

    step: (n, 6) twists. seconds: (n, 1) the time of each step. If there are only two steps, the changes to the next step
    also replace those to the next but one.
    """
    velocity = step / seconds
    once = np.diff(velocity, axis=0) ** 2
    twice = (velocity[2:] - velocity[:-2]) ** 2 if len(velocity) > 2 else once
    return once, twice, once / (1 / seconds[1:] + 1 / seconds[:-1]), 3 * once / (seconds[1:] + seconds[:-1])


def _beside(density: Floats) -> Floats:
    """Return the density (n, 6) in each of n steps, from the densities (n-1, 6) that pairs of neighbours show."""
    both = density[np.r_[0, : len(density)]] + density[np.r_[: len(density), len(density) - 1]]
    return np.asarray((both + _SHARED * density.mean(axis=0)) / (2 + _SHARED))
