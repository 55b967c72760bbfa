"""Tables of arrays that grow by rows, and the tables of paths, keyframes and rays."""

from copy import copy
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.trajectory import Trajectory, travel

_MOST_POSES = 65_536
"""The number of poses of a path above which some poses are dropped. It is reached after 5 minutes at 200 Hz, or 2 hours at
10 Hz. With a larger number, the kept poses of a long path are closer together. Each pose takes 160 bytes."""
_FULL = 0.75
"""The share of `_MOST_POSES` that may stay when poses are dropped. With a larger share, more poses stay, and poses are
dropped more often."""
_LEAST = 0.25
"""The share of `_MOST_POSES` that is reserved for poses that no solve asks for. With a larger share, poses between old
keyframes are closer together. This costs memory in a map with many keyframes."""
_SUMMED = 1024
"""The number of poses for which the travelled way is summed up at once. 1024 poses take 1 ms. A sum over all poses, just
before poses are dropped, would delay one message by 50 ms. With a larger number, sums are rarer, and each sum delays a
message for longer."""
_FIRST = 64  # The rows that a new table has room for. More rows cost memory, fewer rows cost copies in a young session.


def column(kind: DTypeLike, *shape: int) -> Any:
    """Declare a column of a `GrowingTable` by the type of its numbers and the shape of a row."""
    return np.dtype((kind, shape))


class GrowingTable:
    """A table. Each column is an attribute: an array (n, *shape) with one entry per row. Entries may be changed in place.

    Subclasses declare columns with `column`. `add` and `keep` replace all arrays.
    """

    def __init__(self) -> None:
        self._length = 0
        columns = {name: kind for name, kind in vars(type(self)).items() if isinstance(kind, np.dtype)}
        self._room: dict[str, NDArray[Any]] = {name: np.zeros(_FIRST, dtype=kind) for name, kind in columns.items()}
        self._show()

    def __len__(self) -> int:
        return self._length

    def add(self, **rows: ArrayLike) -> None:
        """Append rows (n, ...). The first column must be given. A column that is not given is 0 in the new rows."""
        begin = self._length
        end = begin + len(np.asarray(rows[next(iter(self._room))]))
        for name, room in self._room.items():
            if end > len(room):
                larger = np.zeros((max(end, 2 * len(room)), *room.shape[1:]), dtype=room.dtype)
                larger[:begin] = room[:begin]
                self._room[name] = room = larger
            room[begin:end] = rows.get(name, 0)
        self._length = end
        self._show()

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Keep only the rows that a mask (n,) selects."""
        rows = np.flatnonzero(which)
        for room in self._room.values():
            room[: len(rows)] = room[rows]
        self._length = len(rows)
        self._show()

    def copy(self) -> Self:
        """Return a table with copies of all arrays."""
        other = copy(self)
        other._room = {name: room.copy() for name, room in self._room.items()}
        other._show()
        return other

    def _show(self) -> None:
        for name, room in self._room.items():
            setattr(self, name, room[: self._length])


class PathTable(GrowingTable):
    """The poses of a path in the order of their stamps, as the robot sent them.

    Above _MOST_POSES, poses at even intervals are kept and the others are dropped. So the memory of a session of months is
    bounded. No new gap appears near the stamps that a later solve asks for. Elsewhere, any time may lie between two kept
    poses. The travelled distance and turn between kept poses are also kept, because the drift of the odometry grows with
    both.

    max_gap: s, the shortest time between two poses that is a gap. reach: s, the longest time between a stamp that a solve
    asks for and the poses that it takes. newest: s, the time before the end of the path in which a solve may still ask for
    any stamp.
    """

    stamp: Floats = column(np.float64)
    pose: Floats = column(np.float64, 4, 4)
    travel: Floats = column(np.float64, 3)

    def __init__(self, max_gap: float, reach: float, newest: float) -> None:
        super().__init__()
        self._reach, self._newest = reach + max_gap, newest + max_gap
        self._widest, self._spacing, self._most = max_gap / 4, 0.0, _MOST_POSES
        self._summed, self._thinned = 0, False  # How many poses have `travel`. Whether poses were dropped.

    def append(self, stamp: float, pose: Floats, asked: Floats) -> None:
        """Append a pose (4, 4) at a stamp, s, later than all others. asked: (K,) s, the stamps that later solves ask for."""
        if len(self) >= self._most:
            self._thin(asked)
        if len(self) >= self._summed + _SUMMED:
            self._sum_up()
        self.add(stamp=(stamp,), pose=pose[None], travel=0.0)

    def trajectory(self) -> Trajectory | None:
        """Return a copy of the path, or None if it has no pose."""
        if not len(self):
            return None
        if self._thinned:
            self._sum_up()
        return Trajectory(self.stamp.copy(), self.pose.copy(), self.travel.copy() if self._thinned else None)

    def _thin(self, asked: Floats) -> None:
        """Keep one pose per period, and the poses at gaps. The period doubles until few enough poses stay.

        A period above max_gap / 4 does not apply to poses near `asked` or near the end of the path. If such poses leave too
        little room for others (_LEAST), the limit on the number of poses doubles instead.
        """
        near = self._near(asked)
        self._spacing = self._spacing or min(2 * float(self.stamp[-1] - self.stamp[0]) / len(self), self._widest)
        stays = self._spaced(near)
        while stays.sum() > _FULL * self._most and (
            self._spacing < self._widest or (stays & ~near).sum() > _LEAST * self._most
        ):
            self._spacing *= 2
            stays = self._spaced(near)
        self._sum_up()
        total = np.cumsum(self.travel, axis=0)[stays]
        self.keep(stays)
        self.travel[1:] = np.diff(total, axis=0)
        self._summed, self._thinned = len(self), True
        if len(self) > _FULL * self._most:
            self._most *= 2

    def _spaced(self, near: Bools) -> Bools:
        return self._one_per(self._spacing) | (near & self._one_per(min(self._spacing, self._widest)))

    def _one_per(self, period: float) -> Bools:
        """Return a mask of the first pose in each period, s, and of each pose before a step that is longer than a period."""
        number = np.floor((self.stamp - self.stamp[0]) / period)
        return np.append(True, np.diff(number) > 0) | np.append(np.diff(self.stamp) > period, True)

    def _near(self, asked: Floats) -> Bools:
        """Return a mask of the poses within the reach of the stamps `asked` (K,), s, and of the newest poses."""
        known = np.sort(asked)
        begin, end = self.stamp - self._reach, self.stamp + self._reach
        is_asked = np.searchsorted(known, begin) < np.searchsorted(known, end, "right")
        return np.asarray(is_asked | (self.stamp >= self.stamp[-1] - self._newest))

    def _sum_up(self) -> None:
        """Fill in `travel` of the poses that were appended since the last call."""
        begin = max(self._summed, 1)
        self.travel[begin:] = travel(self.pose[begin - 1 :])
        self._summed = len(self)


class KeyframeTable(GrowingTable):
    """The keyframes in the order of arrival, with columns as in `types.Keyframes` and `course.Placed`.

    camera_T_start: the pose of the course's start in the camera frame. localized: whether map_T_base is from the
    localisation. stamp, base_T_camera: corrected for the shared errors. sent, mount: the stamp and base_T_camera as
    received.
    """

    id: Ints = column(np.int64)
    stamp: Floats = column(np.float64)
    camera: Ints = column(np.int64)
    frame: Ints = column(np.int64)
    base_T_camera: Floats = column(np.float64, 4, 4)
    map_T_base: Floats = column(np.float64, 4, 4)
    start_T_base: Floats = column(np.float64, 4, 4)
    camera_T_start: Floats = column(np.float64, 4, 4)
    drift: Floats = column(np.float64, 6, 6)
    piece: Ints = column(np.int64)
    by_odometry: Bools = column(np.bool_)
    sent: Floats = column(np.float64)
    mount: Floats = column(np.float64, 4, 4)
    localized: Bools = column(np.bool_)


class RayTable(GrowingTable):
    """The rays of the keyframes, one for each box, with columns as in `types.Rays`.

    number: the id of the ray, increasing. owner: the id of its landmark, or -1. used: whether the graph has its factor.
    direction: through the centre of the box. to_centre: the vector that the graph adds to `direction`, so that the sum
    points to the centre of a body. centre_sigma: rad, the standard deviation of `to_centre`.
    """

    number: Ints = column(np.int64)
    keyframe: Ints = column(np.int64)
    direction: Floats = column(np.float64, 3)
    sigma: Floats = column(np.float64)
    range: Floats = column(np.float64)
    range_sigma: Floats = column(np.float64)
    label: Ints = column(np.int64)
    score: Floats = column(np.float64)
    box: Floats = column(np.float64, 4)
    size: Floats = column(np.float64, 2)
    track: Ints = column(np.int64)
    owner: Ints = column(np.int64)
    used: Bools = column(np.bool_)
    to_centre: Floats = column(np.float64, 3)
    centre_sigma: Floats = column(np.float64)
