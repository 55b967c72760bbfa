"""Columns that grow by rows: arrays with room to spare, so that adding a row does not copy all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FIRST = 64  # rows that there is room for at first


class Table:
    """Columns of one length, read as attributes; a column is an array view of the rows so far, to be changed in place."""

    def __init__(self, **columns: tuple[type, tuple[int, ...]]) -> None:
        """columns: the type of each column, and the shape of one of its rows."""
        self._length = 0
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((_FIRST, *shape), dtype=kind) for name, (kind, shape) in columns.items()
        }

    def __len__(self) -> int:
        return self._length

    def __getattr__(self, name: str) -> NDArray[Any]:
        try:
            return self.__dict__["_columns"][name][: self.__dict__["_length"]]
        except KeyError as error:
            raise AttributeError(name) from error

    def add(self, **rows: ArrayLike) -> None:
        """Rows at the end: (n, ...) for each column."""
        arrays = {name: np.asarray(rows[name]) for name in self._columns}
        count = len(next(iter(arrays.values())))
        end = self._length + count
        for name, column in self._columns.items():
            if end > len(column):
                larger = np.zeros((max(end, 2 * len(column)), *column.shape[1:]), dtype=column.dtype)
                larger[: self._length] = column[: self._length]
                self._columns[name] = column = larger
            column[self._length : end] = arrays[name]
        self._length = end

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Only some of the rows (n,), in their order."""
        rows = np.flatnonzero(which)
        for column in self._columns.values():
            column[: len(rows)] = column[rows]
        self._length = len(rows)

    def copy(self) -> Table:
        """The same rows, in columns of their own."""
        other = Table()
        other._length = self._length
        other._columns = {name: column.copy() for name, column in self._columns.items()}
        return other
