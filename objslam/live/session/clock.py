"""One time that never goes back, whatever the robot's clock does."""

from __future__ import annotations

from dataclasses import dataclass, field

from objslam.sources.journal.records import PathKind

_SURE = 5
"""Poses in a row, each newer than the last and all older than what came before, that show a clock set back; larger drops
more poses until it is followed, and takes fewer late ones for it."""
_BACK = 0.5
"""s; what is less far back is late, not from another clock. Larger takes a clock that is set back a little for lateness."""
_KEPT = 8
"""Clocks set back that stamps may still belong to; more only cost memory."""
_MISSED = 0.005
"""s that the path is taken to have gone on while the clock was set back: a step of 200 Hz odometry."""


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


class Lead:
    """Whose stamps set the clock: the odometry's, or the localisation's once it has gone on for max_gap (s) without it.

    path: the one that does; None before the first pose.
    """

    def __init__(self, clock: Clock, max_gap: float) -> None:
        self._clock, self._max_gap = clock, max_gap
        self._newest: dict[PathKind, float] = {}
        self._odometry_until = -float("inf")
        self.path: PathKind | None = None

    def choose(self, path: PathKind, at: float) -> None:
        """A pose of a path comes, at a session time; a path that leads again goes on where it was."""
        silent = at > self._odometry_until + self._max_gap
        if path != self.path and (path == "odometry" or self.path is None or silent):
            self.path, self._clock.newest = path, self._newest.get(path, -float("inf"))

    def heard(self, path: PathKind, at: float) -> None:
        """That pose was taken."""
        self._newest[path] = at
        if path == "odometry":
            self._odometry_until = max(self._newest.values())
