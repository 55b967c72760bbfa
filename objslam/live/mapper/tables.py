"""Tables of arrays that grow by rows, and the tables of keyframes and rays."""

from copy import copy
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.types import Trajectory

_MOST_POSES = 131_072
"""The number of poses of a path above which some are dropped: 11 minutes at 200 Hz. A larger number keeps long paths finer,
for 136 bytes per pose."""
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
        """Append rows (n, ...), given for every column."""
        arrays = {name: np.asarray(rows[name]) for name in self._room}
        end = self._length + len(next(iter(arrays.values())))
        for name, room in self._room.items():
            if end > len(room):
                larger = np.zeros((max(end, 2 * len(room)), *room.shape[1:]), dtype=room.dtype)
                larger[: self._length] = room[: self._length]
                self._room[name] = room = larger
            room[self._length : end] = arrays[name]
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

    Above _MOST_POSES, some are dropped, evenly over time, to save memory. No new gap may arise, so the limit doubles if too
    many poses must stay. max_gap: s, the shortest time between two poses that is a gap.
    """

    stamp: Floats = column(np.float64)
    pose: Floats = column(np.float64, 4, 4)

    def __init__(self, max_gap: float) -> None:
        super().__init__()
        self._widest, self._spacing, self._most = max_gap / 4, 0.0, _MOST_POSES

    def append(self, stamp: float, pose: Floats) -> None:
        """Append a pose (4, 4) at a stamp, s, later than all others."""
        if len(self) >= self._most:
            self._thin()
        self.add(stamp=[stamp], pose=pose[None])

    def trajectory(self) -> Trajectory | None:
        """Return a copy of the path, None if it has no pose."""
        return Trajectory(self.stamp.copy(), self.pose.copy()) if len(self) else None

    def _thin(self) -> None:
        """Keep one pose per period, and the poses at gaps. The period at least doubles each time, up to max_gap / 4."""
        usual = (self.stamp[-1] - self.stamp[0]) / len(self)
        self._spacing = min(max(2 * self._spacing, 2 * usual), self._widest)
        period = np.floor((self.stamp - self.stamp[0]) / self._spacing)
        far = np.append(np.diff(self.stamp) > self._spacing, True)
        self.keep(np.append(True, np.diff(period) > 0) | far)
        if len(self) > 3 * self._most // 4:
            self._most *= 2


class KeyframeTable(GrowingTable):
    """The keyframes in the order of arrival, with columns as in `types.Keyframes` and `course.Placed`.

    camera_T_start: the start of the course in the camera frame. localized: whether map_T_base is from the localisation.
    stamp, base_T_camera: corrected for the shared errors. sent, mount: the same two as received.
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
    track: Ints = column(np.int64)
    owner: Ints = column(np.int64)
    used: Bools = column(np.bool_)
