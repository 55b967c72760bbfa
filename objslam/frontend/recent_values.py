"""Keep the last values of a slow function."""

from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class RecentValues(Generic[Value]):
    """The last values of a function, by its arguments."""

    def __init__(self, most: int) -> None:
        """Keep `most` values. A larger number takes more memory."""
        self._most = most
        self._values: dict[tuple[float, ...], Value] = {}

    def get(self, key: tuple[float, ...], compute: Callable[[], Value]) -> Value:
        """Return the value of a key, computed if it is not kept. The least recently used value is dropped first."""
        found = self._values.pop(key) if key in self._values else compute()
        self._values[key] = found
        if len(self._values) > self._most:
            self._values.pop(next(iter(self._values)))
        return found
