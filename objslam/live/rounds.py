"""Slow work on the whole map of a running session. It is done in rounds. In each round, a separate process does the work,
and then its answer corrects the map."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Generic, TypeVar

from objslam.live.mapper.maintenance import is_quiet
from objslam.live.worker import Request, Worker, solved
from objslam.sources.journal.corrections import Correction

if TYPE_CHECKING:
    from objslam.live.mapper.mapper import Mapper

Answer = TypeVar("Answer")
Told = TypeVar("Told", bound=Correction)


class Rounds(ABC, Generic[Answer, Told]):
    """Decides after each keyframe whether a round begins, and whether the last round corrects the map.

    A round begins when the number of keyframes has grown by the factor `growth` since the last round began. So the time of
    all rounds is proportional to the number of keyframes. The map is corrected when the number has grown by the share
    `delay` since the round began. Both steps wait for a keyframe without other tasks (`is_quiet`). If the process is done by
    then, the map does not depend on the machine's speed. If the process is late, a `patient` session waits for its answer,
    and any other session goes on. The journal receives each correction with its keyframe. So a resumed session corrects its
    map at the same keyframe.
    """

    growth: float
    delay: float
    quick: bool
    """Whether a round takes less time than the start of a process. If so, a patient session does the work without a process,
    and any other session keeps its process running."""
    told: type[Told]
    """The class of the corrections."""

    def __init__(self, mapper: Mapper, record: Callable[[Told], bool], first: int, patient: bool) -> None:
        """Prepare for a session. record: writes a correction to the journal, and returns whether the correction may be made.

        first: the number of keyframes at the first round, 0 for none. patient: whether the session may wait for the process.
        """
        self._mapper, self._record, self._patient = mapper, record, patient
        self._next = first or math.inf
        # The number of keyframes when a round began, and its request. Once the process has the request, the request is
        # dropped to save memory.
        self._asked: tuple[int, Request[Answer] | None] | None = None
        self._worker: Worker[Answer] = Worker()
        self._known: deque[Told] = deque()
        self._replaying = False

    def expect(self, known: Iterable[Correction]) -> None:
        """Replay the corrections of class `told` from a journal, each at its keyframe. No process gets work before
        `begin`."""
        self._known, self._replaying = deque(one for one in known if isinstance(one, self.told)), True

    def begin(self) -> None:
        """Continue after the journal of a resumed session. Repeat the last round if it had not yet corrected the map."""
        self._replaying = False
        if self._asked is not None and self._asked[1] is not None and not self._here:
            self._worker.ask(self._asked[1])
            self._asked = self._asked[0], None

    def after_keyframe(self) -> bool:
        """Start or end a round if it is due, and return whether the map was corrected."""
        number, changed = self._mapper.state.next_id.keyframe, False
        while self._known and self._known[0].keyframe <= number:
            self._correct(self._known.popleft())
            self._asked, changed = None, True
        if not is_quiet(number):
            return changed
        if self._asked is not None and not self._replaying:
            changed |= self._finish(number)
        if number >= self._next:
            self._next = math.ceil(self.growth * number)
            if self._asked is None or self._replaying:
                self._ask(number)
        return changed

    def close(self) -> None:
        """End the process."""
        self._worker.close()

    @property
    def _here(self) -> bool:
        """Whether the session does the work without a separate process."""
        return self.quick and self._patient

    def _ask(self, number: int) -> None:
        request = self._request()
        if request is None:
            return
        self._asked = number, request if self._replaying or self._here else None
        if self._asked[1] is None:
            self._worker.ask(request)

    def _finish(self, number: int) -> bool:
        """Correct the map by the answer of the process if it is due. Return whether the map was corrected."""
        worker, m = self._worker, self._mapper.state
        assert self._asked is not None
        due = number >= self._asked[0] * (1 + self.delay) and not m.graph.is_rebuilding
        if not due or not (self._patient or worker.done):
            return False
        request, self._asked = self._asked[1], None
        answer = worker.result() if request is None else solved(request)
        if not self.quick:
            worker.close()  # Rounds are rare, and the process takes memory.
        found = self._correction(number, answer)
        if found is None or not self._record(found):
            return False
        self._correct(found)
        return True

    def _correct(self, correction: Told) -> None:
        self._take_up(correction)
        self._mapper.map_has_moved()

    @abstractmethod
    def _request(self) -> Request[Answer] | None:
        """Return the work of a round that begins now, or None if nothing is to be done."""

    @abstractmethod
    def _correction(self, number: int, answer: Answer | None) -> Told | None:
        """Return the correction that an answer makes at keyframe `number`, or None if the map stays as it is. The answer is
        None if the process failed."""

    @abstractmethod
    def _take_up(self, correction: Told) -> None:
        """Correct the map. The new map depends only on the old map and the correction."""
