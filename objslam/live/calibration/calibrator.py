"""Decides when a running session estimates its shared errors, such as clock offsets, and when the estimates correct the
map."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.config import Noise, Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import LENS, OBSERVABLE, Calibration, kind
from objslam.core.noise import NoiseFactors
from objslam.frontend.shared_errors import SharedErrors
from objslam.live.calibration.collected import collect
from objslam.live.calibration.recalibration import recalibrate
from objslam.live.calibration.request import CalibrationRequest
from objslam.live.counters import Counters
from objslam.live.rounds import Rounds
from objslam.sources.journal.corrections import CalibrationMessage

if TYPE_CHECKING:
    from objslam.live.mapper.mapper import Mapper

_GROWTH = 1.5
"""The factor by which the number of keyframes grows between the starts of two calibrations. Because the intervals grow, the
time of all calibrations is proportional to the number of keyframes. A larger factor calibrates more rarely."""
_DELAY = 0.15
"""The share by which the number of keyframes grows between the start of a calibration and the correction of the map. If the
worker is done by then, the map does not depend on the machine's speed. A larger share suits slower machines, but corrects
later."""
_CHANGED = 1.0
"""The change of an error, in standard deviations, above which the map is corrected. A larger value corrects more rarely."""
_LIKE = 0.2
"""The relative change of the localisation's noise, or of the time for which its errors last, above which the map is
corrected. After a short drive, the estimates of two rounds differ by about this share. A larger share corrects more
rarely."""
_NO_DELAY = 2.0
"""The largest delay of a camera clock that a session does not correct, in standard deviations of the estimate. With a
correction, each frame would wait longer for its pose, by the offset of the clock, although the gain is small. A larger value
maps sooner, but with larger errors. At 1, one of six right clocks looks late in each round. A first round then made each of
the next 600 frames wait 65 ms. At 2, one of forty right clocks looks late."""


_LATE = frozenset(("turn_slip", "turn_per_m", *LENS))
"""The kinds of errors that a session estimates only at its end, if no calibration file has them. After a few curves, a slip
looks like a wrong scale of turns. After a short drive, an error of the lens looks like an error of the clock together with a
turn of the camera. So the other estimates would become worse. When slip was estimated while the robot drove, three of four
sessions of MRCLAM 6, robot 3, had up to five landmarks too many. When the lens was estimated, the map of a simulated drive
with a late clock was 12 cm off after 100 frames instead of 3 cm."""


def observed(found: Calibration, now: Floats) -> Calibration:
    """Return a calibration in which errors that the session does not observe keep their present values, `now` (P,).

    Otherwise, noise would move the map with each calibration. A camera clock that is behind by no more than `_NO_DELAY` is
    not corrected. Observed errors get their most probable values, given the other values. The covariance is about the new
    values, so it contains the distance of the new values from the most probable values.
    """
    clock = np.array([kind(name) == "clock" for name in found.names], dtype=bool)
    behind = clock & (found.values > 0) & (found.values <= _NO_DELAY * found.sigma)
    kept = np.where(behind, 0.0, now)
    stay = behind | (found.sigma > OBSERVABLE * found.prior)
    if not stay.any():
        return found
    values, covariance = found.values.copy(), found.covariance
    values[~stay] += covariance[np.ix_(~stay, stay)] @ np.linalg.solve(covariance[np.ix_(stay, stay)], (kept - values)[stay])
    values[stay] = kept[stay]
    moved = values - found.values
    return replace(found, values=values, covariance=covariance + np.outer(moved, moved))


def _waits_in_vain(found: Calibration, now: Floats) -> bool:
    """Return whether frames wait because of the value of a camera clock in `now` (P,), although this clock may be right
    (`observed`)."""
    clock = np.array([kind(name) == "clock" for name in found.names], dtype=bool)
    return bool((clock & (now > 0) & (found.values == 0)).any())


def _without_late(errors: SharedErrors, theta: Floats, known: Container[str]) -> tuple[SharedErrors, Floats]:
    """Return shared errors and their values (P,). Errors of the kinds `_LATE` are left out, unless they are in `known`."""
    some = np.array([kind(name) not in _LATE or name in known for name in errors.names], dtype=bool)
    names = tuple(name for name, kept in zip(errors.names, some.tolist(), strict=True) if kept)
    return replace(errors, names=names, mean=errors.mean[some], prior=errors.prior[np.ix_(some, some)]), theta[some]


class Calibrator(Rounds[tuple[Calibration, NoiseFactors] | None, CalibrationMessage]):
    """Estimates the shared errors and the noise of the localisation in rounds, and corrects the map by them."""

    growth, delay, quick, told = _GROWTH, _DELAY, False, CalibrationMessage

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[CalibrationMessage], bool],
        name: str,
        patient: bool,
    ) -> None:
        """Prepare for a session. name: the name of the log. The other arguments are as in `Rounds`."""
        super().__init__(mapper, record, settings.live.calibrate_from, patient)
        self._counters, self._name = counters, name

    def _request(self) -> CalibrationRequest | None:
        """Return a request with all keyframes. Return None if no shared errors are to be estimated, or if the map has no
        objects.

        Only the noise of the localisation is estimated. Until the end of the session, all other noise stays as in the
        settings, and so do the errors `_LATE`.
        """
        m = self._mapper.state
        found = collect(m, self._name, running=True)
        errors, theta = found.errors, found.theta
        if errors is None or theta is None or not found.association.count:
            return None
        errors, theta = _without_late(errors, theta, m.errors)
        if not len(theta):
            return None
        known = Noise(rays=False, ranges=False, odometry=False, localization=m.given.noise.localization)
        settings = m.given.model_copy(update={"noise": known})
        errors = replace(errors, settings=settings)
        return CalibrationRequest(errors, theta, found.association, found.map_T_camera, settings)

    def _correction(self, number: int, answer: tuple[Calibration, NoiseFactors] | None) -> CalibrationMessage | None:
        """Return the calibration if it changes an error (`_CHANGED`) or the noise (`_LIKE`) enough to correct the map, or if
        frames wait in vain. Else return None."""
        if answer is None:
            self._counters.accept("calibrations given up")
            return None
        m, (calibration, noise) = self._mapper.state, answer
        now = np.array([m.errors.get(name, 0.0) for name in calibration.names])
        found = observed(calibration, now)
        far = (np.abs(found.values - now) > _CHANGED * calibration.sigma).any() or _waits_in_vain(found, now)
        if not far and noise.like(m.localization.noise, _LIKE):
            self._counters.accept("calibrations without a change")
            return None
        return CalibrationMessage(number, found, noise)

    def _take_up(self, correction: CalibrationMessage) -> None:
        recalibrate(self._mapper.state, correction.calibration, correction.noise)
        self._counters.accept("calibrations")
