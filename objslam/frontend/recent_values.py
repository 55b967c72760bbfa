"""Keep the last values of a slow function, or its values for objects that are in use."""

import weakref
from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")
Thing = TypeVar("Thing")


class ValuesOfObjects(Generic[Thing, Value]):
    """The values of a function of objects that never change. A value is kept as long as its object lives, so the value must
    not refer to the object."""

    def __init__(self, compute: Callable[[Thing], Value]) -> None:
        """Keep the values of a function."""
        self._compute = compute
        self._values: dict[int, Value] = {}

    def __call__(self, of: Thing) -> Value:
        """Return the value of an object. It is computed if it is not kept."""
        key = id(of)
        if key not in self._values:
            self._values[key] = self._compute(of)
            weakref.finalize(of, self._values.pop, key, None).atexit = False
        return self._values[key]


class RecentValues(Generic[Value]):
    """The last values of a function, by its arguments."""

    def __init__(self, most: int) -> None:
        """Keep `most` values. A larger number takes more memory."""
        self._most = most
        self._values: dict[tuple[float, ...], Value] = {}

    def get(self, key: tuple[float, ...], compute: Callable[[], Value]) -> Value:
        """Return the value of a key. It is computed if it is not kept. The least recently used value is dropped first."""
        found = self._values.pop(key) if key in self._values else compute()
        self._values[key] = found
        if len(self._values) > self._most:
            self._values.pop(next(iter(self._values)))
        return found
