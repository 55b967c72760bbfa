"""Decides when a running session estimates its shared errors, such as clock offsets, and when these correct the map."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.config import Noise, Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import OBSERVABLE, Calibration
from objslam.live.calibration.collected import collect
from objslam.live.calibration.recalibration import recalibrate
from objslam.live.calibration.request import CalibrationRequest
from objslam.live.counters import Counters
from objslam.live.worker import Worker
from objslam.sources.journal.records import CalibrationMessage

if TYPE_CHECKING:
    from objslam.live.mapper.mapper import Mapper

_GROWTH = 1.5
"""A calibration begins when the number of keyframes has grown by this factor since the last calibration began. As the
intervals grow, the time of all calibrations is proportional to the number of keyframes. A larger factor calibrates more
rarely."""
_DELAY = 0.15
"""The map is corrected when the number of keyframes has grown by this share since the calibration began. If the worker is
done by then, the map does not depend on the machine's speed. A larger share suits slower machines, but corrects later."""
_CHANGED = 1.0
"""The map is corrected if an error has changed by more than this, in standard deviations. A larger value corrects more
rarely."""


def observed(found: Calibration, now: Floats) -> Calibration:
    """Return a calibration in which errors that the session does not observe keep their present values, `now` (P,).

    Otherwise, noise would move the map with each calibration. Observed errors get their most probable values, given the
    values that are kept.
    """
    stay = found.sigma > OBSERVABLE * found.prior
    if not stay.any():
        return found
    values, covariance = found.values.copy(), found.covariance
    values[~stay] += covariance[np.ix_(~stay, stay)] @ np.linalg.solve(covariance[np.ix_(stay, stay)], (now - values)[stay])
    values[stay] = now[stay]
    return replace(found, values=values)


class Calibrator:
    """Decides after each keyframe whether a calibration begins (_GROWTH) or corrects the map (_DELAY).

    If the worker is late, a `patient` session waits for it, and any other session goes on. The journal receives each applied
    calibration with its keyframe, so that a resumed session applies it there.
    """

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[CalibrationMessage], bool],
        name: str,
        patient: bool,
    ) -> None:
        """Prepare for a session. record: writes a calibration to the journal, and returns whether it may be applied.

        name: the name of the log. patient: whether the session may wait for the worker.
        """
        self._counters, self._mapper, self._record, self._name, self._patient = counters, mapper, record, name, patient
        self._next = settings.live.calibrate_from or math.inf
        # The number of keyframes when a calibration began, and its request. Once the worker has the request, it is dropped
        # to save memory.
        self._asked: tuple[int, CalibrationRequest | None] | None = None
        self._worker: Worker[Calibration | None] = Worker()
        self._known: deque[CalibrationMessage] = deque()
        self._replaying = False

    def expect(self, known: Iterable[CalibrationMessage]) -> None:
        """Apply the calibrations of a journal, each at its keyframe. Start no new calibrations until `begin`."""
        self._known, self._replaying = deque(known), True

    def begin(self) -> None:
        """Continue after the journal of a resumed session. Repeat a calibration that had begun but not been applied."""
        self._replaying = False
        if self._asked is not None and self._asked[1] is not None:
            self._worker.ask(self._asked[1])
            self._asked = self._asked[0], None

    def after_keyframe(self) -> bool:
        """Start or apply a calibration if it is due, and return whether the map was corrected."""
        number, changed = self._mapper.state.next_id.keyframe, False
        while self._known and self._known[0].keyframe <= number:
            self._take_up(self._known.popleft().calibration)
            self._asked, changed = None, True
        if self._worker.busy:
            changed |= self._finish(number)
        if number >= self._next:
            self._next = math.ceil(_GROWTH * number)
            if self._asked is None or self._replaying:
                self._ask(number)
        return changed

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def _ask(self, number: int) -> None:
        """Begin a calibration with all keyframes, if shared errors are to be estimated and there are objects.

        The noise is not estimated. It stays as in the settings until the end of the session.
        """
        m = self._mapper.state
        found = collect(m, self._name, count_dropped=False)
        if found.errors is None or found.theta is None or not len(found.theta) or not found.association.count:
            return
        known = Noise(rays=False, ranges=False, odometry=False, localization=False)
        settings = m.given.model_copy(update={"noise": known})
        errors = replace(found.errors, settings=settings)
        request = CalibrationRequest(errors, found.theta, found.association, found.map_T_camera, settings)
        self._asked = number, request if self._replaying else None
        if not self._replaying:
            self._worker.ask(request)

    def _finish(self, number: int) -> bool:
        """Apply the worker's calibration if it is due and changes an error enough. Return whether it was applied."""
        worker, m = self._worker, self._mapper.state
        assert self._asked is not None
        due = number >= self._asked[0] * (1 + _DELAY) and not m.graph.is_rebuilding
        if not due or not (self._patient or worker.done):
            return False
        found, self._asked = worker.result(), None
        worker.close()  # Calibrations are rare, and the process takes memory.
        if found is None:
            self._counters.accept("calibrations given up")
            return False
        now = np.array([m.errors.get(name, 0.0) for name in found.names])
        found = observed(found, now)
        far = (np.abs(found.values - now) > _CHANGED * found.sigma).any()
        if not far:
            self._counters.accept("calibrations without a change")
            return False
        if not self._record(CalibrationMessage(number, found)):
            return False
        self._take_up(found)
        return True

    def _take_up(self, calibration: Calibration) -> None:
        recalibrate(self._mapper.state, calibration)
        self._mapper.map_has_moved()
        self._counters.accept("calibrations")
