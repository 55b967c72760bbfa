"""The session's clock: session time never goes back, even when the robot's clock does."""

from dataclasses import dataclass, field

from objslam.sources.journal.records import PathKind

_SURE = 5  # The consecutive older poses that prove a clock set back. A larger number follows it later, but more surely.
_BACK = 0.5  # The least step of a clock set back, s. A smaller step is lateness. A larger value ignores small steps.
_KEPT = 8  # The number of earlier clocks that stamps may still belong to. More clocks only cost memory.
_MISSED = 0.005  # The advance of the path while the clock is set back, s. It is a step of odometry at 200 Hz.


@dataclass
class Clock:
    """Converts stamps to session time, in which the stamps of the path increase.

    shift: the time, s, that is now added to a stamp. newest: the newest stamp of the path in session time, s, or -inf.
    """

    shift: float = 0.0
    newest: float = -float("inf")
    _older: list[float] = field(default_factory=list)
    _shifts: list[float] = field(default_factory=list)

    def step(self, stamp: float) -> tuple[float | None, bool]:
        """Return a path's stamp in session time (None if late or repeated), and whether the clock was set back."""
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
        """Return any other stamp in session time, by the latest clock that puts it between oldest and latest."""
        for shift in (self.shift, *reversed(self._shifts)):
            if oldest <= stamp + shift <= latest:
                return stamp + shift
        return stamp + self.shift


class Lead:
    """Chooses the `path` whose stamps set the clock (None before the first pose).

    The odometry sets the clock. The localisation takes over when it continues for max_gap (s) without odometry.
    """

    def __init__(self, clock: Clock, max_gap: float) -> None:
        self._clock, self._max_gap = clock, max_gap
        self._newest: dict[PathKind, float] = {}
        self._odometry_until = -float("inf")
        self.path: PathKind | None = None

    def choose(self, path: PathKind, at: float) -> None:
        """Update the leading path for a new pose at a session time. A path that leads again resumes at its newest stamp."""
        silent = at > self._odometry_until + self._max_gap
        if path != self.path and (path == "odometry" or self.path is None or silent):
            self.path, self._clock.newest = path, self._newest.get(path, -float("inf"))

    def heard(self, path: PathKind, at: float) -> None:
        """Record that a pose at a session time was accepted."""
        self._newest[path] = at
        if path == "odometry":
            self._odometry_until = max(self._newest.values())
