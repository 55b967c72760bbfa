"""Instruments for the scales of the odometry. The neighbours of a motion predict the motion without its own noise.

An instrument replaces a derivative whose noise is also in the residuals. It correlates with the derivative, but its own
errors do not correlate with the residuals. So the estimate has no bias (instrumental variables).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import adjoint, inverse
from objslam.core.types import Keyframes
from objslam.graph.calibration.linearised_graph import Linearised

ODOMETRY_SCALES = ("odometry.scale", "odometry.lateral_scale", "odometry.turn_scale")
"""The names of the parameters that scale the odometry. The derivatives by them are measured motions, and so contain the
noise of the odometry."""
_ALIKE = 3.0
"""The largest ratio of the variances that neighbours predict to the variances of the motion itself. The inverse ratio has
the same limit. With a larger limit, motions that differ from their neighbours make the parameters less certain. With 10, the
clock of a robot that often stands had a standard deviation five times as large. With a smaller limit, the noise of a motion
changes the weight of the motion."""
_MOMENT = 0.025
"""The time (s) within which frames of several cameras belong to one moment. Such frames are too close in time to show how
fast the robot moves. With a larger value, velocities and the neighbours of motions come from a longer time, so short turns
are lost."""


@dataclass(frozen=True)
class Motions:
    """The s measured motions in the graph, as twists of base with the rotation (rad) first and the translation (m) after it.

    to_twist: (s, 6, 6) from the whitened rows of a motion to its twist. to_rows: (s, 6, 6) from the twist to the rows.
    weight: (s,) the robust weights. covariance: (s, 6, 6) of the twists, as the neighbours of each motion predict it.
    by_odometry: (s, 6) the share of the odometry in the standard deviations of a twist. The rest comes from the interpolated
    path. seconds: (s,) s, the durations. rows: the rows of the motions in the linear system. tied: as in `OdometryMotions`.
    moment: s, as in `from_neighbours`.
    """

    to_twist: Floats
    to_rows: Floats
    weight: Floats
    covariance: Floats
    by_odometry: Floats
    seconds: Floats
    rows: slice
    tied: float
    moment: float

    @classmethod
    def of(cls, of: Linearised) -> Self:
        """Return the motions of a graph with odometry."""
        keyframes, (before, after), odometry = of.measured.keyframes, of.graph.moves, of.measured.motions
        assert odometry is not None
        robust = of.graph.motion_weights(of.map_T_camera)
        to_base = adjoint(keyframes.base_T_camera[after])
        seconds = np.maximum(keyframes.stamps[after] - keyframes.stamps[before], 0.0)
        covariance = to_base @ odometry.covariance @ np.swapaxes(to_base, 1, 2)
        moment = moment_of(keyframes)
        near = from_neighbours(covariance.reshape(-1, 36), seconds, moment).reshape(-1, 6, 6)
        near = np.where((np.einsum("kii->k", near) > 0)[:, None, None], near, covariance)
        roots = robust[:, None, None] * of.graph.motion_roots
        to_rows = roots @ adjoint(inverse(keyframes.base_T_camera[after]))
        noise = np.einsum("kij,kjl,kil->ki", to_base, odometry.noise, to_base)
        by_odometry = np.sqrt(noise / np.einsum("kii->ki", covariance))
        first = of.graph.first_motion
        rows = slice(first, first + 6 * len(after))
        to_twist, like = to_base @ np.linalg.inv(roots), _alike(near, covariance)
        return cls(to_twist, to_rows, robust, like, by_odometry, seconds, rows, odometry.tied, moment)

    def twists(self, columns: Floats) -> Floats:
        """Return the twists (s, 6, n) of columns (M, n) of the linear system."""
        return self.to_twist @ columns[self.rows].reshape(len(self.seconds), 6, columns.shape[1])

    def whitened(self, twists: Floats) -> Floats:
        """Return the rows (6 s, n) of twists (s, 6, n)."""
        return np.asarray((self.to_rows @ twists).reshape(6 * len(twists), twists.shape[2]))

    def predicted(self, twists: Floats) -> Floats:
        """Return the prediction (s, 6, n) of twists (s, 6, n) by their neighbours."""
        return from_neighbours(twists.reshape(len(twists), -1), self.seconds, self.moment).reshape(twists.shape)

    def weighted(self, twists: Floats) -> Floats:
        """Return the rows (6 s, n) of twists (s, 6, n) that are weighted by the inverse of `covariance`.

        The product of a row with the residuals is the weighted product of a twist with the residual twist.
        """
        weighted = self.weight[:, None, None] ** 2 * np.linalg.solve(self.covariance, twists)
        return np.asarray((np.swapaxes(self.to_twist, 1, 2) @ weighted).reshape(6 * len(twists), twists.shape[2]))


def motion_instruments(motions: Motions | None, names: Sequence[str], sides: Floats) -> Floats:
    """Return instruments (M, P). They are the `LinearSystem.sides` (M, P) without the noise of single motions.

    The noise of a motion is both in its derivative by a scale of the odometry and in its residual. The product of the two
    would bias the scale upwards if the odometry is measured, and downwards if it is a command to the robot. The neighbours
    of a motion are like it, and their noise is independent. So they predict the derivative (instrumental variables; Fuller
    1987, 1.4).

    The noise is also in the weight of a motion, because longer motions have more noise. So motions that were measured too
    short would weigh more, and bias the errors of the odometry. Hence the neighbours also predict the covariance for the
    errors of the odometry. The prediction has limits (`_ALIKE`), because a motion between two stops differs from its
    neighbours. The derivatives by other errors do not point along the noise that changes the weight.

    If the clocks of the cameras of a multiframe differ, the odometry also moves these cameras against each other. Such short
    motions are mostly noise, and tell next to nothing about the odometry. So the instruments leave the rays out.
    """
    instruments = sides.copy()
    own = [k for k, name in enumerate(names) if name.startswith("odometry.")]
    if motions is not None and own:
        scaled = np.isin([names[k] for k in own], ODOMETRY_SCALES)
        twists = motions.twists(sides[:, own])
        twists[..., scaled] = motions.predicted(twists[..., scaled])
        instruments[: motions.rows.start, own] = 0.0
        instruments[motions.rows, own] = motions.weighted(twists)
    return instruments


def _alike(near: Floats, covariance: Floats) -> Floats:
    """Return covariances (s, 6, 6) like `near`, but with variances that differ from `covariance` at most by `_ALIKE`.

    near, covariance: (s, 6, 6).
    """
    root = np.linalg.cholesky(covariance)
    back = np.linalg.inv(root)
    size, axes = np.linalg.eigh(back @ near @ np.swapaxes(back, 1, 2))
    axes = root @ axes
    return (axes * np.clip(size, 1 / _ALIKE, _ALIKE)[:, None]) @ np.swapaxes(axes, 1, 2)


def moment_of(keyframes: Keyframes) -> float:
    """Return the time, s, within which keyframes belong to one moment. It is `_MOMENT` with several cameras, else 0."""
    return _MOMENT if len(keyframes) and np.ptp(keyframes.camera) > 0 else 0.0


def from_neighbours(motions: Floats, seconds: Floats, moment: float) -> Floats:
    """Return a prediction (n, D) of each motion (n, D): its own duration times the rate of two motions before and two after
    it.

    The motion directly before it and the one directly after it do not count, because they may share a step of the odometry
    with it, and so share its noise. The frames of several cameras may be milliseconds apart. So on each side, all motions
    within `moment` s of the motion do not count, and the neighbours that count last at least three times as long as
    `moment`. seconds: (n,) s, the durations.
    """
    count = len(motions)
    ends = np.append(0.0, np.cumsum(seconds))
    total = np.vstack([np.zeros((1, motions.shape[1])), np.cumsum(motions, axis=0)])
    near, time = np.zeros_like(motions), np.zeros((count, 1))
    forward = _after(ends, moment)
    back = tuple(count - one[::-1] for one in _after(ends[-1] - ends[::-1], moment))[::-1]
    for first, last in (forward, back):
        near += total[last] - total[first]
        time += (ends[last] - ends[first])[:, None]
    return np.asarray(np.where(time > 0, near / np.maximum(time, 1e-9), 0.0) * seconds[:, None])


def _after(ends: Floats, moment: float) -> tuple[Ints, Ints]:
    """Return for each of n motions the index (n,) of the first later motion that counts, and the index (n,) after the last
    one.

    ends: (n+1,) s, the start of the first motion, followed by the ends of all motions. moment: s, as in `from_neighbours`.
    """
    count = len(ends) - 1
    first = np.maximum(np.arange(count) + 2, np.searchsorted(ends[:-1], ends[1:] + moment))
    first = np.minimum(first, count)
    last = np.maximum(first + 2, np.searchsorted(ends, ends[first] + 3 * moment))
    return first, np.minimum(last, count)
