"""The robot's course through a session: odometry places a frame where there is some, else localisation does.

Both are put into one frame, in which the drift is summed up: that of the first pose. Where the one takes over from the
other, or the odometry comes back after a gap, the localisation tells how the new piece lies to the old one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse
from objslam.graph.factors.odometry import UNKNOWN_TURN, UNKNOWN_WAY
from objslam.live.mapper.tables import KeyframeTable
from objslam.live.mapper.trajectory_buffer import PathBuffer

_KEPT = 3.0
"""s besides live.max_late that the paths are kept for, since a frame also waits its turn; longer costs memory."""
_LOCALIZED = -1
"""The stretch of what the localisation places: its poses are in one frame throughout."""


@dataclass(frozen=True)
class Placed:
    """Where a frame was taken: map_T_base (4, 4) as its path gives it, start_T_base (4, 4) and drift (6, 6) on the course.

    piece: the number of its piece of the course; between two frames of one piece the path tells the motion.
    """

    by_odometry: bool
    piece: int
    map_T_base: Floats
    start_T_base: Floats
    drift: Floats


@dataclass(frozen=True)
class _Piece:
    """A stretch of a path on the course: how its frame lies there, and the drift (6, 6) to add to the path's own."""

    stretch: int
    start_T_path: Floats
    drift: Floats


class Course:
    """Both paths as they come, and where they have the robot."""

    def __init__(self, settings: Settings) -> None:
        seconds, self._max_gap = settings.live.max_late + _KEPT, settings.poses.max_gap
        self.odometry = PathBuffer(settings.odometry, seconds, self._max_gap)
        self.localization = PathBuffer(settings.odometry, seconds, self._max_gap)
        self._noise = settings.localization.yaw, settings.localization.xy
        self._localized_by_then = -np.inf
        self._pieces: list[_Piece] = []
        self._last: Placed | None = None
        self._newest = -np.inf

    def add_odometry(self, stamp: float, pose: Floats) -> None:
        """One more pose (4, 4) of the odometry."""
        self.odometry.append(stamp, pose)
        self._localized_by_then = self.localization.newest

    def ready(self, stamp: float) -> bool:
        """Whether it is decided what places a frame, or that nothing does.

        While the odometry is silent, which is once the localisation has gone on for poses.max_gap without it, the
        localisation does. Where the odometry begins a piece, the localisation is waited for until it has come so far.
        """
        odometry, localization = self.odometry, self.localization
        if odometry.newest < stamp:
            silent = localization.newest - max(odometry.newest, self._localized_by_then) > self._max_gap
            return silent and localization.newest >= stamp
        if localization.newest >= stamp or odometry.newest - localization.newest > self._max_gap:
            return True
        stretch = odometry.stretch(stamp)
        goes_on = self._last is None or self._pieces[self._last.piece].stretch == stretch
        return stretch is not None and (goes_on or localization.newest >= odometry.stretch_begin)

    def place(self, stamp: float, keyframes: KeyframeTable, before: int | None) -> Placed | None:
        """Where a frame was taken; None off both paths, or where it is late and on no piece of the course so far.

        before: the row of the keyframe before it.
        """
        on, path = self.odometry.at(stamp), self.odometry
        if on is None:
            on, path = self.localization.at(stamp), self.localization
        if on is None:
            return None
        by_odometry = path is self.odometry
        stretch = on.stretch if by_odometry else _LOCALIZED
        near = [] if before is None else [int(keyframes.piece[before])]
        near += [] if self._last is None else [self._last.piece]
        number = next((n for n in near if self._pieces[n].stretch == stretch), len(self._pieces))
        pose = path.from_start(on.pose)
        if number == len(self._pieces):
            if stamp < self._newest:
                return None
            self._pieces.append(self._begin(stretch, path, stamp, keyframes))
        piece = self._pieces[number]
        to_start = adjoint(piece.start_T_path)
        drift = piece.drift + to_start @ on.drift @ to_start.T
        placed = Placed(by_odometry, number, on.pose, piece.start_T_path @ pose, drift)
        if stamp >= self._newest:
            self._last, self._newest = placed, stamp
        return placed

    def _begin(self, stretch: int, path: PathBuffer, stamp: float, keyframes: KeyframeTable) -> _Piece:
        """A new piece, whose first frame is at a stamp.

        How it lies is read off at the newest stamp by then that the localisation covers as well.
        """
        last = self._last
        if last is None:
            return _Piece(stretch, np.eye(4), np.zeros((6, 6)))
        old, goes_on = self._pieces[last.piece], path is self.odometry and last.by_odometry
        localized = np.flatnonzero(keyframes.localized & (keyframes.stamp <= stamp))
        if goes_on and not len(localized):  # nothing else tells how the robot moved in a gap of the odometry
            return _Piece(stretch, old.start_T_path, old.drift)
        both = min(stamp, self.localization.newest)
        on, there = path.at(both), self.localization.at(both)
        if len(localized) and on is not None and there is not None and (path is self.localization or on.stretch == stretch):
            row = localized[keyframes.stamp[localized].argmax()]
            start_T_base = keyframes.start_T_base[row] @ inverse(keyframes.map_T_base[row]) @ there.pose
            drift = 2 * last.drift - keyframes.drift[row]  # what was gathered since then tells nothing about the new piece
            return self._lay(stretch, start_T_base, drift, path.from_start(on.pose), on.drift, self._noise)
        on = path.at(stamp)
        assert on is not None  # for a frame was placed by it
        pose = path.from_start(on.pose)
        start_T_base = old.start_T_path @ pose if goes_on else last.start_T_base
        return self._lay(stretch, start_T_base, last.drift, pose, on.drift, (UNKNOWN_TURN, UNKNOWN_WAY))

    def _lay(
        self, stretch: int, start_T_base: Floats, drift: Floats, pose: Floats, own: Floats, noise: tuple[float, float]
    ) -> _Piece:
        """The piece on which a pose (4, 4) of its path, with a drift (6, 6) of its own, is start_T_base on the course.

        drift: (6, 6) by then on the course. noise: rad, m; how little it is known that the pose is there.
        """
        start_T_path = start_T_base @ inverse(pose)
        to_start, to_base = adjoint(start_T_path), adjoint(start_T_base)
        turn, way = noise
        tilt, z = (0.0, 0.0) if self.odometry.planar and self.localization.planar else noise
        drift = drift + (to_base * np.array([tilt, tilt, turn, way, way, z]) ** 2) @ to_base.T
        return _Piece(stretch, start_T_path, drift - to_start @ own @ to_start.T)
