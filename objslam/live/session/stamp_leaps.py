"""Messages whose stamps leap ahead. They wait until the next messages of their stream confirm or refute them.

A stream is what one publisher sends: a path, the frames of a camera, or the mounts of a camera. Because of the wait, a
single wrong stamp moves no clock. A real gap, or a clock that is set forward, loses no message.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_SURE = 3
"""The number of messages in a row that confirm a leap. With a larger number, wrong stamps pass more rarely, but the first
messages after a gap wait longer."""
_LAG = 0.3
"""The lead, s, below which a stamp is no leap. This covers the usual lags between topics. With a larger value, a wrong stamp
can move the clock further, and fewer messages wait after short pauses."""
_STEPS = 3.0
"""The lead, in usual steps of the stream, up to which a stamp is no leap. For slow streams, a larger value has the same
effect as a larger `_LAG`."""
_KEPT = 8  # The number of last steps whose median is the usual step. With a larger number, a new rate is learned later.
_APART = 60.0
"""The longest step, s, between messages that confirm each other. It is also the longest step that is no leap in a stream
whose usual step is not known yet. Frames that are further ahead wait for the path. With a larger value, more wrong stamps
confirm each other."""
_MOST = 16  # The most messages of a stream that wait. A larger number costs memory if somebody makes up stamps.

T = TypeVar("T")


@dataclass
class _Stream(Generic[T]):
    """One stream of messages. last: its newest stamp, s. steps: the last steps between its stamps, s. waiting: the waiting
    messages with their stamps."""

    last: float | None = None
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    waiting: list[tuple[float, T]] = field(default_factory=list)

    def hear(self, stamp: float) -> None:
        """Record the stamp, s, of a message that passes."""
        if self.last is not None and stamp > self.last:
            self.steps.append(stamp - self.last)
        self.last = stamp if self.last is None else max(self.last, stamp)

    def reach(self, stamp: float) -> float:
        """Return the latest stamp, s, that is no leap after a given stamp, s."""
        usual = sorted(self.steps)[(len(self.steps) - 1) // 2] if self.steps else None
        return stamp + (_APART if usual is None else max(_LAG, _STEPS * usual))

    def leaps(self, stamp: float, clock: float, alone: bool) -> bool:
        """Return whether a stamp is too far ahead of its stream, and of the clock of the other streams."""
        if clock == -float("inf") and not (alone and self.last is not None):  # No other stamp can refute it.
            return False
        return stamp > clock + _LAG and (self.last is None or stamp > self.reach(self.last))

    def chain(self) -> list[float]:
        """Return the waiting stamps that form a chain to the newest one, in order."""
        found = [self.waiting[-1][0]]
        for stamp, _ in reversed(self.waiting):
            if found[-1] - _APART <= stamp < found[-1]:
                found.append(stamp)
        return found[::-1]

    def pass_on(self, stamps: list[float]) -> list[T]:
        """Remove the waiting messages with these stamps, and return them in order."""
        passing = sorted((one for one in self.waiting if one[0] in stamps), key=lambda one: one[0])
        self.waiting = [one for one in self.waiting if one[0] not in stamps]
        for stamp, _ in passing:
            self.hear(stamp)
        return [message for _, message in passing]

    def near(self, until: float) -> list[T]:
        """Remove the waiting messages up to a stamp, s, and return them in order."""
        return self.pass_on([stamp for stamp, _ in self.waiting if stamp <= until])

    def empty(self) -> list[T]:
        """Remove all waiting messages, and return them."""
        waited, self.waiting = self.waiting, []
        return [message for _, message in waited]


class StampLeaps(Generic[T]):
    """Decides for each message whether it passes, waits, or is refuted. Stamps are the robot's, in s."""

    def __init__(self) -> None:
        self._streams: dict[str, _Stream[T]] = {}

    def take(self, stream: str, stamp: float, clock: float, message: T, alone: bool) -> tuple[list[T], list[T]]:
        """Take the next message of a stream. Return the messages that pass, in order, and the refuted messages.

        clock: the newest stamp, s, of another stream, or -inf without one. It confirms stamps that are not far ahead of it.
        alone: whether the stream itself may confirm a leap of more than `_APART`, as a path may. If not, such a leap waits
        for the clock.
        """
        s = self._streams.setdefault(stream, _Stream())
        before = s.last
        if s.leaps(stamp, clock, alone):
            s.waiting.append((stamp, message))
            chain = s.chain()
            if len(chain) < _SURE or not (alone or stamp <= clock + _APART):
                return [], [s.waiting.pop(0)[1]] if len(s.waiting) > _MOST else []
            s.last = None
            s.steps.clear()
            return s.pass_on(chain), s.empty()
        s.hear(stamp)
        if not s.waiting or (before is not None and stamp <= before):  # A late message neither confirms nor refutes a leap.
            return [message], []
        earlier = s.near(stamp)
        return [*earlier, message, *s.near(s.reach(stamp))], s.empty()

    def confirmed(self, clock: float) -> list[T]:
        """Return the waiting messages of all streams that another stream has reached. clock: the newest stamp of that
        stream, s."""
        return [message for s in self._streams.values() if s.waiting for message in s.near(clock + _LAG)]

    def recall(self, stream: str, stamp: float) -> None:
        """Record the stamp, s, of a message of the stream that passed earlier."""
        self._streams.setdefault(stream, _Stream()).hear(stamp)

    def clear(self) -> list[T]:
        """Forget all streams, because the clock was set back or the session ends. Return the messages that waited."""
        waited = [message for s in self._streams.values() for message in s.empty()]
        self._streams.clear()
        return waited
