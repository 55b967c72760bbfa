"""Messages whose stamps leap ahead. They wait until the next messages of their stream confirm or refute them.

A stream is what one publisher sends: a path, or the frames or the mounts of a camera. So a single wrong stamp moves no
clock, and a real gap, or a clock that is set forward, costs no message.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_SURE = 3
"""A leap is real if this many messages in a row confirm it. A larger number is surer, and the first messages after a gap
wait longer."""
_LAG = 0.3
"""A stamp is no leap if it is ahead by less, s. This covers the usual lags between topics. With a larger value, a wrong
stamp can move the clock further, and fewer messages wait after short pauses."""
_STEPS = 3.0
"""A stamp is no leap within this many usual steps of its stream. A larger value acts on slow streams like a larger
`_LAG`."""
_KEPT = 8  # The last steps whose median is the usual one. A larger number adapts later to another rate.
_APART = 60.0
"""The longest step, s, between messages that confirm each other. It is also the longest step that is no leap in a stream
whose usual step is not known yet. Frames that are further ahead wait for the path. With a larger value, more wrong stamps
confirm each other."""
_MOST = 16  # The most messages of a stream that wait. A larger number costs memory if somebody makes up stamps.

T = TypeVar("T")


@dataclass
class _Stream(Generic[T]):
    """One stream of messages: its newest stamp, the last steps (s) between its stamps, and the waiting messages with their
    stamps."""

    last: float | None = None
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    waiting: list[tuple[float, T]] = field(default_factory=list)

    def hear(self, stamp: float) -> None:
        """Take note of a message that passes."""
        if self.last is not None and stamp > self.last:
            self.steps.append(stamp - self.last)
        self.last = stamp if self.last is None else max(self.last, stamp)

    def reach(self, stamp: float) -> float:
        """Return the latest stamp, s, that is no leap from a stamp."""
        usual = sorted(self.steps)[(len(self.steps) - 1) // 2] if self.steps else None
        return stamp + (_APART if usual is None else max(_LAG, _STEPS * usual))

    def leaps(self, stamp: float, clock: float, alone: bool) -> bool:
        """Return whether a stamp is too far ahead of its stream, and of the clock of the other streams."""
        if clock == -float("inf") and not (alone and self.last is not None):  # There is nothing to compare it with.
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

        clock: the newest stamp, s, of another stream, -inf if there is none. It confirms stamps that are not far ahead of
        it. alone: whether the stream itself may confirm a leap of more than `_APART`, as a path may. If not, such a leap
        waits for the clock.
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
        if not s.waiting or (before is not None and stamp <= before):  # A late message says nothing about messages ahead.
            return [message], []
        earlier = s.near(stamp)
        return [*earlier, message, *s.near(s.reach(stamp))], s.empty()

    def confirmed(self, clock: float) -> list[T]:
        """Return, from all streams, the waiting messages that another stream has reached. clock: its newest stamp, s."""
        return [message for s in self._streams.values() if s.waiting for message in s.near(clock + _LAG)]

    def recall(self, stream: str, stamp: float) -> None:
        """Take note of a message of the stream that passed earlier."""
        self._streams.setdefault(stream, _Stream()).hear(stamp)

    def clear(self) -> list[T]:
        """Forget all streams, because the clock was set back or the session ends. Return the messages that waited."""
        waited = [message for s in self._streams.values() for message in s.empty()]
        self._streams.clear()
        return waited
