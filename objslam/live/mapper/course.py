"""Joins odometry and localisation to one path, the course of the robot. The frame of its first pose is `start`.

Odometry and localisation are two paths, and gaps divide a path into stretches. The course is a chain of pieces. A piece is
one stretch, or a localisation that replaces missing odometry. If possible, localisation also places a piece relative to
earlier pieces.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.frontend.corrected_odometry import OdometryCorrection
from objslam.frontend.odometry_drift import gathered_drift
from objslam.graph.factors.odometry import UNKNOWN_TURN, UNKNOWN_WAY
from objslam.live.mapper.tables import KeyframeTable, PathTable
from objslam.live.mapper.trajectory_buffer import PathBuffer

_KEPT = 3.0  # Poses are kept for live.max_late plus this time, s, for queued frames. A larger value costs memory.
_LOCALIZED = -1  # The stretch number of every pose from localisation, because all these poses share one coordinate frame.


@dataclass(frozen=True)
class Placed:
    """The pose of the robot at the stamp of an image, from the odometry or from the localisation.

    piece: the number of the piece. The motion between two images of one piece is measured. map_T_base: (4, 4) the pose in
    the frame of its path, odom or map. start_T_base: (4, 4) the pose on the course. drift: (6, 6) the drift covariance that
    the course has accumulated up to the pose. by_odometry: whether the odometry gives the pose.
    """

    by_odometry: bool
    piece: int
    map_T_base: Floats
    start_T_base: Floats
    drift: Floats


@dataclass(frozen=True)
class _Piece:
    """A piece of the course.

    stretch: the number of the stretch of the odometry, or _LOCALIZED. start_T_path: (4, 4) places the first pose of the path
    on the course. drift: (6, 6) the covariance to add to the path's own drift, to get the drift on the course.
    """

    stretch: int
    start_T_path: Floats
    drift: Floats


class Course:
    """The paths of odometry and localisation, and the course that they form.

    driven, localized: the odometry and the localisation since the start, as received. In a long session, some of their poses
    are dropped. odometry, localization: the poses of the last seconds. `odometry` is corrected for its shared errors.
    """

    def __init__(self, settings: Settings, correction: OdometryCorrection | None = None) -> None:
        seconds = settings.live.max_late + _KEPT + settings.calibration.max_clock
        self._max_gap = settings.poses.max_gap
        self._correction = correction or OdometryCorrection({})
        self.odometry = PathBuffer(settings.odometry, seconds, self._max_gap)
        self.localization = PathBuffer(settings.odometry, seconds, self._max_gap)
        reach = 2 * settings.calibration.max_clock  # A clock correction may move a stamp from one bound to the other.
        self.driven = PathTable(self._max_gap, reach, seconds)
        self.localized = PathTable(self._max_gap, reach, seconds)
        self._noise = settings.localization.yaw, settings.localization.xy
        self._localized_by_then = -np.inf
        self._pieces: list[_Piece] = []
        self._last: Placed | None = None
        self._newest = -np.inf

    def add_odometry(self, stamp: float, pose: Floats, keyframes: KeyframeTable) -> None:
        """Append a pose (4, 4) of the odometry at a stamp, s, later than all others. keyframes: the keyframes of the map so
        far."""
        self.driven.append(stamp, pose, keyframes.stamp)
        self.odometry.append(stamp, self._correction.correct(stamp, pose))
        self._localized_by_then = self.localization.newest

    def add_localization(self, stamp: float, pose: Floats, keyframes: KeyframeTable) -> None:
        """Append a pose of the localisation, as `add_odometry`."""
        self.localized.append(stamp, pose, keyframes.stamp)
        self.localization.append(stamp, pose)

    def recalibrate(
        self, errors: Mapping[str, float], corrected: Trajectory | None, settings: Settings, keyframes: KeyframeTable
    ) -> None:
        """Correct the odometry by new values of its errors, and move the pieces of the course and the keyframes accordingly.

        errors: the new values by name. corrected: the whole odometry, corrected by these values. keyframes: the keyframes
        with their new stamps and map_T_base. This function changes their start_T_base and drift. A piece with a frame of its
        own keeps the pose of its first keyframe.
        """
        said = self.driven.trajectory()
        self._correction = OdometryCorrection(errors, said, corrected)
        if corrected is not None:
            self.odometry.replace(corrected, settings.odometry)
        k = keyframes
        if not len(k):
            return
        reckoned, path = np.flatnonzero(k.by_odometry), self.localized.trajectory()
        on_path = np.tile(np.eye(4), (len(k), 1, 1))
        drift = np.zeros((len(k), 6, 6))
        others = np.flatnonzero(~k.by_odometry)
        if corrected is not None:
            at = k.stamp[reckoned].clip(corrected.stamps[0], corrected.stamps[-1])
            poses, _ = interpolate(corrected.stamps, corrected.poses, at, np.inf)
            on_path[reckoned] = inverse(corrected.poses[0]) @ poses
            drift[reckoned] = gathered_drift(corrected, at, settings.odometry)
        if path is not None and len(others):
            on_path[others] = self.localization.from_start(k.map_T_base[others])
            drift[others] = gathered_drift(path, k.stamp[others], settings.odometry)
        starts = [piece.start_T_path for piece in self._pieces]
        for number, old in enumerate(list(self._pieces)):
            mine = np.flatnonzero(k.piece == number)
            before = self._pieces[number - 1]
            if number and starts[number] is starts[number - 1]:
                piece = _Piece(old.stretch, before.start_T_path, before.drift)
            elif number and len(mine):
                first = mine[k.stamp[mine].argmin()]
                start_T_path = k.start_T_base[first] @ inverse(on_path[first])
                to_start = adjoint(start_T_path)
                piece = _Piece(old.stretch, start_T_path, k.drift[first] - to_start @ drift[first] @ to_start.T)
            else:
                piece = old
            self._pieces[number] = piece
            to_start = adjoint(piece.start_T_path)
            k.drift[mine] = piece.drift + to_start @ drift[mine] @ to_start.T
            k.start_T_base[mine] = piece.start_T_path @ on_path[mine]
        newest = int(k.stamp.argmax())
        self._newest = float(k.stamp[newest])
        self._last = Placed(
            bool(k.by_odometry[newest]),
            int(k.piece[newest]),
            k.map_T_base[newest].copy(),
            k.start_T_base[newest].copy(),
            k.drift[newest].copy(),
        )

    def ready(self, stamp: float) -> bool:
        """Return whether all poses that `place` needs for a frame with this stamp have arrived.

        If the odometry has not reached the frame, the frame waits until the localisation has continued alone for
        poses.max_gap, and has reached the frame. The first frame after a gap of the odometry waits until the localisation
        reaches the end of the gap, or is more than poses.max_gap behind.
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
        """Return the pose of a frame. Return None if no path covers the frame's stamp. Return None for a late frame if no
        existing piece of the course covers it.

        before: the row of the last keyframe before the frame.
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
        if number == len(self._pieces):
            if stamp < self._newest:
                return None
            self._pieces.append(self._begin(stretch, path, stamp, keyframes))
        piece = self._pieces[number]
        to_start = adjoint(piece.start_T_path)
        drift = piece.drift + to_start @ on.drift @ to_start.T
        placed = Placed(by_odometry, number, on.pose, piece.start_T_path @ path.from_start(on.pose), drift)
        if stamp >= self._newest:
            self._last, self._newest = placed, stamp
        return placed

    def by_localization(self, stamp: float, piece: int) -> tuple[Floats, Floats] | None:
        """Return map_T_base (4, 4) of a frame by the localisation, and the drift (6, 6) of the odometry since the localised
        pose.

        The odometry of the piece of the frame leads from the newest localised pose to the frame, unless the localisation has
        reached it. Return None if one of the two paths has no such poses.
        """
        then = min(stamp, self.localization.newest)
        on = self.localization.at(then)
        if on is None or then == stamp:
            return None if on is None else (on.pose, np.zeros((6, 6)))
        begin, end = self.odometry.at(then), self.odometry.at(stamp)
        if begin is None or end is None or begin.stretch != end.stretch:
            return None
        to_start = adjoint(self._pieces[piece].start_T_path)
        return on.pose @ inverse(begin.pose) @ end.pose, to_start @ (end.drift - begin.drift) @ to_start.T

    def _begin(self, stretch: int, path: PathBuffer, stamp: float, keyframes: KeyframeTable) -> _Piece:
        """Make a new piece that starts at a stamp, s. If possible, the newest localisation up to the stamp places it."""
        last = self._last
        if last is None:
            return _Piece(stretch, np.eye(4), np.zeros((6, 6)))
        old, goes_on = self._pieces[last.piece], path is self.odometry and last.by_odometry
        localized = np.flatnonzero(keyframes.localized & (keyframes.stamp <= stamp))
        if goes_on and not len(localized):  # Without localisation, the odometry also gives the motion in its gap.
            return _Piece(stretch, old.start_T_path, old.drift)
        both = min(stamp, self.localization.newest)
        on, there = path.at(both), self.localization.at(both)
        if len(localized) and on is not None and there is not None and (path is self.localization or on.stretch == stretch):
            row = localized[keyframes.stamp[localized].argmax()]
            start_T_base = keyframes.start_T_base[row] @ inverse(keyframes.map_T_base[row]) @ there.pose
            drift = 2 * last.drift - keyframes.drift[row]  # The drift of `last`, plus the drift from the keyframe to `last`.
            return self._lay(stretch, start_T_base, drift, path.from_start(on.pose), on.drift, self._noise)
        on = path.at(stamp)
        assert on is not None
        pose = path.from_start(on.pose)
        start_T_base = old.start_T_path @ pose if goes_on else last.start_T_base
        return self._lay(stretch, start_T_base, last.drift, pose, on.drift, (UNKNOWN_TURN, UNKNOWN_WAY))

    def _lay(
        self, stretch: int, start_T_base: Floats, drift: Floats, pose: Floats, own: Floats, noise: tuple[float, float]
    ) -> _Piece:
        """Return the piece of the course that puts `pose` (4, 4) of the path at start_T_base (4, 4) on the course.

        own: (6, 6) drift of the path at `pose`. drift: (6, 6) drift of the course at start_T_base. noise: (rad, m) the
        standard deviations by which the two poses may differ.
        """
        start_T_path = start_T_base @ inverse(pose)
        to_start, to_base = adjoint(start_T_path), adjoint(start_T_base)
        turn, way = noise
        tilt, z = (0.0, 0.0) if self.odometry.planar and self.localization.planar else noise
        drift = drift + (to_base * np.array([tilt, tilt, turn, way, way, z]) ** 2) @ to_base.T
        return _Piece(stretch, start_T_path, drift - to_start @ own @ to_start.T)
