"""Instruments for the offsets of clocks. They are derivatives that use the velocities of the solved path instead of measured
velocities."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse, log_se3
from objslam.graph.calibration.instruments import Motions, moment_of
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.rays_across import RaysAcross


@dataclass(frozen=True)
class ClockInstruments:
    """The instruments of clocks (see `instruments`), as a linear function of velocities of base at the K poses of a graph.

    If a clock changes, a motion changes by the difference of the velocities at its two ends. In a multiframe, the rays of
    one camera move against those of another. The noise of measured velocities is also in the residuals, so it would bias the
    clock. The velocities of the solved path do not correlate with the residuals, so the instruments use them.

    A twist has the rotation first (rad), and the translation after it (m). A velocity is a twist per s. Matrices (..., 6, 6)
    convert twists or velocities.

    moved: for each clock, by the index of its parameter, a mask (K,) of the poses whose images have this clock. moves: (s,)
    and (s,), the poses before and after each motion in the graph. motions: the s motions, None without odometry. back: (s,
    6, 6) from twists before a motion to twists after it. absolute: (a, 6, 6) from velocities to the rows of absolute poses.
    first: the first row of absolute poses. before, after: (K,) the two poses from which the velocity at a pose is computed.
    along: (K, 6, 6) from twists of `before` to twists of `after`. seconds: (K,) s, the time from `before` to `after`, 0
    without a measured motion. to_base: (K, 6, 6) from twists of the camera to twists of base. velocity: (K, 6) the
    velocities of base on the solved path. across: the rays of cameras that are not the first of their multiframe.
    """

    moved: Mapping[int, Bools]
    moves: tuple[Ints, Ints]
    motions: Motions | None
    back: Floats
    absolute: Floats
    first: int
    before: Ints
    after: Ints
    along: Floats
    seconds: Floats
    to_base: Floats
    velocity: Floats
    across: RaysAcross

    @classmethod
    def of(cls, of: Linearised, moved: Mapping[int, Bools], motions: Motions | None, across: RaysAcross) -> Self:
        """Return the instruments of a graph. moved, motions, across: as in the class."""
        keyframes, graph = of.measured.keyframes, of.graph
        path = of.map_T_camera @ inverse(keyframes.base_T_camera)
        stamps = np.maximum.accumulate(keyframes.stamps)
        before, after = _around(stamps, keyframes.measured, 2 * moment_of(keyframes))
        seconds = stamps[after] - stamps[before]
        moves = inverse(path[before]) @ path[after]
        _, roots, _ = graph.absolute_roots(of.map_T_camera)
        local = len(roots) == len(path)  # With a localisation. Otherwise, the only absolute pose is the first.
        rate = np.where(seconds > 0, 1 / np.maximum(seconds, 1e-9), 0.0)
        return cls(
            moved,
            graph.moves,
            motions,
            adjoint(inverse(path[graph.moves[1]]) @ path[graph.moves[0]]),
            roots @ adjoint(inverse(keyframes.base_T_camera)) if local else np.zeros((0, 6, 6)),
            graph.first_motion + 6 * len(graph.motion_roots),
            before,
            after,
            adjoint(inverse(moves)),
            seconds,
            adjoint(keyframes.base_T_camera),
            log_se3(moves) * rate[:, None],
            across,
        )

    def put(self, instruments: Floats, clock: int, velocity: Floats) -> None:
        """Write the instruments of a clock, for n sets of velocities (K, 6, n), into the columns `instruments` (M, n)."""
        own = self._own(clock, velocity)
        if self.motions is not None:
            instruments[self.motions.rows] = -self.motions.whitened(self._changes_of_motions(own))
        if len(self.absolute):
            rows = (self.absolute @ own).reshape(-1, own.shape[2])
            instruments[self.first : self.first + len(rows)] = -rows
        self.across.put(instruments, clock, velocity)

    def products(self, residual: Floats, clock: int, velocity: Floats) -> Floats:
        """Return the products (n,) of residuals (M,) with the columns that `put` writes, without building the columns."""
        own = self._own(clock, velocity)
        products = np.zeros(own.shape[2])
        if self.motions is not None:
            pull = np.einsum("kji,kj->ki", self.motions.to_rows, residual[self.motions.rows].reshape(-1, 6))
            products -= np.einsum("ki,kin->n", pull, self._changes_of_motions(own))
        if len(self.absolute):
            last = self.first + 6 * len(self.absolute)
            pull = np.einsum("kji,kj->ki", self.absolute, residual[self.first : last].reshape(-1, 6))
            products -= np.einsum("ki,kin->n", pull, own)
        return products + np.einsum("ki,kin->n", self.across.pull(residual, clock, len(velocity)), velocity)

    def _own(self, clock: int, velocity: Floats) -> Floats:
        """Return the velocities (K, 6, n) of the poses that a clock moves, with 0 for all other poses."""
        return np.where(self.moved[clock][:, None, None], velocity, 0.0)

    def _changes_of_motions(self, own: Floats) -> Floats:
        """Return the changes (s, 6, n) of the motions by velocities (K, 6, n), for a clock change of 1 s."""
        first, last = self.moves
        return np.asarray(own[last] - self.back @ own[first])

    def changes(self, poses: Floats) -> Floats:
        """Return the changes (K, 6, n) of the velocities if the camera poses change by the twists `poses` (K, 6, n)."""
        moved = self.to_base @ poses
        change = moved[self.after] - self.along @ moved[self.before]
        return np.asarray(np.where(self.seconds > 0, 1 / np.maximum(self.seconds, 1e-9), 0.0)[:, None, None] * change)


def _around(stamps: Floats, measured: Bools, apart: float) -> tuple[Ints, Ints]:
    """Return for each pose the last pose (K,) at least `apart` s before it, and the first pose (K,) at least `apart` s after
    it.

    If such a pose does not exist, the result is the first or last pose that measured motions connect with the pose. stamps:
    (K,) s. measured: (K-1,) whether the motion to the next pose is measured.
    """
    index = np.arange(len(stamps))
    breaks = np.flatnonzero(~measured)
    path = np.searchsorted(breaks, index)
    first, last = np.append(0, breaks + 1)[path], np.append(breaks, len(stamps) - 1)[path]
    before = np.minimum(np.searchsorted(stamps, stamps - apart, side="right") - 1, index - 1)
    after = np.maximum(np.searchsorted(stamps, stamps + apart), index + 1)
    return np.maximum(before, first), np.minimum(after, last)
