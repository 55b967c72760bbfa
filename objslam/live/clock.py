"""One time that never goes back, whatever the robot's clock does."""

from __future__ import annotations

from dataclasses import dataclass, field

_SURE = 5
"""So many poses in a row, all older than what came before, each newer than the last, are a clock that was set back."""
_BACK = 0.5  # s; what is less far back is late, not from another clock
_KEPT = 8  # clocks set back that stamps may still belong to
_MISSED = 0.005  # s; what a step of the path may have taken that the clock's jump hides


@dataclass
class Clock:
    """Adds to every stamp what makes the path's stamps increase; shift: s, as of now."""

    shift: float = 0.0
    newest: float = -float("inf")
    _older: list[float] = field(default_factory=list)
    _shifts: list[float] = field(default_factory=list)

    def step(self, stamp: float) -> tuple[float | None, bool]:
        """A stamp of the path as session time, None for one that is late or repeats, and whether the clock was set back."""
        time = stamp + self.shift
        if time > self.newest:
            self.newest = time
            self._older.clear()
            return time, False
        if time > self.newest - _BACK:
            return None, False
        if self._older and stamp <= self._older[-1]:
            self._older.clear()
        self._older.append(stamp)
        if len(self._older) < _SURE:
            return None, False
        self._shifts = [*self._shifts, self.shift][-_KEPT:]
        self.shift = self.newest + _MISSED - stamp
        self.newest = stamp + self.shift
        self._older.clear()
        return self.newest, True

    def place(self, stamp: float, oldest: float, latest: float) -> float:
        """A stamp of anything else as session time: by the latest clock that puts it between oldest and latest."""
        for shift in (self.shift, *reversed(self._shifts)):
            if oldest <= stamp + shift <= latest:
                return stamp + shift
        return stamp + self.shift
