"""The clock of a session. It converts stamps to session time, which never goes back, even when the robot's clock does."""

from dataclasses import dataclass, field

from objslam.sources.journal.records import PathKind

_SURE = 5  # This many poses in a row older than the path show a clock set back. A larger number is surer but slower.
_BACK = 0.5  # A pose that is older than the path by less than this, s, is only late. A larger value ignores larger steps.
_KEPT = 8  # The earlier shifts kept for stamps from before the clock changed. More shifts only cost memory.
_MISSED = 0.005  # The assumed time, s, between the poses before and after a step back: one period at 200 Hz.


@dataclass
class Clock:
    """Converts stamps to session time. In session time, the stamps of the path always increase.

    shift: the time, s, that is now added to each stamp. newest: the newest stamp of the path, in session time, s. It is -inf
    before the first pose.
    """

    shift: float = 0.0
    newest: float = -float("inf")
    _older: list[float] = field(default_factory=list)  # The stamps of the last poses in a row that were older than the path.
    _shifts: list[float] = field(default_factory=list)  # Earlier values of `shift`, the newest last.

    def step(self, stamp: float) -> tuple[float | None, bool]:
        """Return two values for a new pose. The first is its session time, s, or None if the pose is refused. The second is
        whether the robot's clock was set back.

        A pose that is late or repeated is refused. The first poses after the clock was set back also look late. A single
        wrong stamp ahead of the others does not reach this method, because `stamp_leaps` refuses it.
        """
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
        """Return a stamp in session time, s, and leave the clock as it is. oldest, latest: bounds in session time, s.

        The newest shift that puts the stamp between `oldest` and `latest` is used. If no shift does, the present shift is
        used.
        """
        for shift in (self.shift, *reversed(self._shifts)):
            if oldest <= stamp + shift <= latest:
                return stamp + shift
        return stamp + self.shift


class Lead:
    """Chooses the path whose stamps set the clock. path: the chosen path, or None before the first pose.

    The odometry leads. The localisation leads before the first odometry, and when it continues for max_gap, s, without
    odometry.
    """

    def __init__(self, clock: Clock, max_gap: float) -> None:
        self._clock, self._max_gap = clock, max_gap
        self._newest: dict[PathKind, float] = {}
        self._odometry_until = -float("inf")
        self.path: PathKind | None = None

    def choose(self, path: PathKind, at: float) -> None:
        """Choose again for a new pose of a path. at: session time of the pose, s.

        A path that leads again continues from its own newest stamp.
        """
        silent = at > self._odometry_until + self._max_gap
        if path != self.path and (path == "odometry" or self.path is None or silent):
            self.path, self._clock.newest = path, self._newest.get(path, -float("inf"))

    def heard(self, path: PathKind, at: float) -> None:
        """Record that a pose of a path was accepted. at: its session time, s."""
        self._newest[path] = at
        if path == "odometry":
            self._odometry_until = max(self._newest.values())
