"""Tables that grow by rows, with room to spare so that a new row copies nothing; and those of keyframes and rays."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objslam.core.arrays import Bools, Floats, Ints

_FIRST = 64
"""Rows that a new table has room for. More costs memory, fewer costs copies while a session is young."""


class Column(NamedTuple):
    """What a column holds: the type of a number, and the shape of one row."""

    kind: type
    shape: tuple[int, ...]


def column(kind: type, *shape: int) -> Any:
    """Declares a column in the body of a `GrowingTable`; on a table, the name is the array of its rows (n, *shape)."""
    return Column(kind, shape)


class GrowingTable:
    """Columns of one length. A column is an attribute: the array of the rows so far, to be changed in place.

    A subclass declares its columns with `column`. `add` and `keep` make new arrays of the attributes.
    """

    def __init__(self) -> None:
        self._length = 0
        self._room: dict[str, NDArray[Any]] = {
            name: np.zeros((_FIRST, *of.shape), dtype=of.kind)
            for name, of in vars(type(self)).items()
            if isinstance(of, Column)
        }
        self._show()

    def __len__(self) -> int:
        return self._length

    def add(self, **rows: ArrayLike) -> None:
        """Rows at the end: (n, ...) for each column."""
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
        """Only some of the rows (n,), in their order."""
        rows = np.flatnonzero(which)
        for room in self._room.values():
            room[: len(rows)] = room[rows]
        self._length = len(rows)
        self._show()

    def copy(self) -> Self:
        """The same rows, in arrays of their own."""
        other = type(self)()
        other._length = self._length
        other._room = {name: room.copy() for name, room in self._room.items()}
        other._show()
        return other

    def _show(self) -> None:
        for name, room in self._room.items():
            setattr(self, name, room[: self._length])


class KeyframeTable(GrowingTable):
    """The keyframes, in the order in which they came; columns as `types.Keyframes` has them, and `course.Placed`.

    camera_T_start: the beginning of the course in the camera's frame. localized: whether map_T_base is of the localisation,
    as it is from the beginning without odometry.
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
    localized: Bools = column(np.bool_)


class RayTable(GrowingTable):
    """The rays of the keyframes, one a box; columns as `types.Rays` has them.

    number: of each ray, increasing. owner: the id of its landmark, -1 without. used: whether the graph has its factor.
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
