"""Run all checks of the input of a log: those of the log itself, and those on how well its boxes agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Ints
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.known_errors import estimates, possible
from objslam.mapping.checks.agreement import Agreement, Part, agreement, bounded_part, pose_noise
from objslam.mapping.checks.boxes import check_boxes, check_stamps
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.halves import check_halves
from objslam.mapping.checks.hypotheses import later
from objslam.mapping.checks.mixture import check_mixture
from objslam.mapping.checks.path import check_path
from objslam.mapping.checks.ranges import check_ranges
from objslam.mapping.checks.small_errors import SmallErrors, find_small_errors, with_clock
from objslam.mapping.checks.trials import Trial, crooked, try_hypotheses, verdict
from objslam.mapping.progress import Progress

_ALARM = 0.6
"""The share of boxes that fit below which a run tries hypotheses. A larger share costs more runs a few seconds."""
_FITTING = 0.82
"""How well the boxes that fit must do so on average (`Agreement.fit`), for Gaussian noise 0.9. A larger value costs more
runs a few seconds."""
_ALARM_CLOCKS = (-1.0, -0.5, 0.5, 1.0)
"""The offsets (s) of a clock that every run tries. A clock that is off by more fits better already on the way to it."""
_CROWD = 5.0
"""The crowd (`Part.crowd`) above which rays meet anywhere and tell nothing. A larger crowd takes longer."""
_FEWEST = 60
"""The fewest boxes of a log that are judged by how they agree. Fewer boxes agree by chance."""
_MOVED = 0.05
"""The rotation (rad) of a camera between the halves of a log from which on it was moved. A larger one warns less often."""
_MOVED_BY_ODOMETRY = 0.1
"""As `_MOVED`, for poses that are odometry, whose drift looks like a rotation."""
_MOVED_SIGMAS = 6.0
"""How many standard deviations this rotation must be away from 0. A larger number warns less often."""
_CLOCKS = (-0.3, -0.15, 0.15, 0.3)
"""The offsets (s) of a clock from which small errors are looked for as well. More offsets take longer."""
_GAIN_MOVED = 0.03
"""The least growth of the score when each half has its own camera rotation. A larger one names fewer moved cameras."""
_GAIN = 0.02
"""The least growth of the score when small errors are taken out. A larger one names fewer errors."""


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a log. trials: the hypotheses that were tried, with the log as it is first; empty if none were.

    errors: small errors of the calibration that a run does not correct, None if there are none.
    """

    findings: tuple[Finding, ...] = ()
    trials: tuple[Trial, ...] = ()
    errors: SmallErrors | None = None

    @property
    def spoilt(self) -> bool:
        """Whether no position of the map can be relied on."""
        return any(finding.spoils for finding in self.findings)

    @property
    def refutable(self) -> bool:
        """Whether a solve that explains the boxes may refute a finding."""
        return any(finding.basis != "log" for finding in self.findings)

    def with_findings(self, more: Sequence[Finding]) -> Self:
        """Return the diagnosis with more findings."""
        return replace(self, findings=(*self.findings, *more))


def diagnose(
    log: Log, settings: Settings, progress: Progress = lambda stage, done, total: None, *, thorough: bool = False
) -> Diagnosis:
    """Return what is wrong with a log. thorough: whether to try hypotheses even if nothing is odd.

    LogError if the stamps of the frames and those of the poses have different units.
    """
    if log.localization is None and log.odometry is None:
        return Diagnosis()
    stamps = check_stamps(log)
    if stamps is not None and stamps.spoils:
        raise LogError(stamps.message, where=log.name, hint="write all stamps in s")
    findings = [*([stamps] if stamps else []), *check_path(log), *check_boxes(log)]
    if not any(len(c.detections.frame_stamps) for c in log.cameras if c.detections is not None):
        return Diagnosis(tuple(findings))
    part = bounded_part(log, settings)
    if part.crowd > _CROWD:
        return Diagnosis(tuple(findings))
    found = agreement(part, part.log, settings)
    trials: list[Trial] = []
    if part.boxes >= _FEWEST:
        odd = bool(findings) or crooked(log) or _misfits(part, found, settings)
        if odd or thorough:
            trials = try_hypotheses(part, log, found, settings, progress)
            named = verdict(trials, part)
            if named is not None:
                return Diagnosis((named, *findings), tuple(trials))
    errors: SmallErrors | None = None
    if found is not None and part.boxes >= _FEWEST:
        mixed = check_mixture(found, part)
        findings += [mixed] if mixed else _halves(part, found, settings)
        if not any(finding.spoils for finding in findings):
            errors = _small_errors(part, found, settings)
            if errors is not None:
                cause = f"at the given poses the boxes fit best with {errors.in_words()}: {errors.causes()}"
                # The objects are given the covariance that such an error causes.
                findings.append(Finding("calibration", f"{cause} ({errors.remedy(settings)} estimates it)", spoils=False))
        ranges = check_ranges(found, part)
        findings += [ranges] if ranges else []
    return Diagnosis(tuple(findings), tuple(trials), errors)


def _misfits(part: Part, found: Agreement | None, settings: Settings) -> bool:
    """Return whether few boxes fit, whether those that fit do so poorly, or whether more fit with another clock."""
    if found is None or found.share < _ALARM or found.fit.sum() < _FITTING * (found.point >= 0).sum():
        return True
    trials = [agreement(part, later(part.log, offset), settings) for offset in _ALARM_CLOCKS]
    return any(trial is not None and trial.score > found.score for trial in trials)


def _small_errors(part: Part, found: Agreement, settings: Settings) -> SmallErrors | None:
    """Return small errors that are worth a warning, and that a run in this mode does not estimate."""
    if part.drifts or settings.mode == "joint":
        return None
    noise = pose_noise(part, settings)
    start, best, log = found, 0.0, part.log
    for offset in _CLOCKS:  # a clock that is far off loses the rays that would tell it
        moved = later(part.log, offset)
        trial = agreement(part, moved, settings)
        if trial is not None and trial.score > start.score + _GAIN:
            start, best, log = trial, offset, moved
    errors = find_small_errors(log, start, settings, noise)
    if best:
        errors = with_clock(errors, best, part.log, found, settings)
    if errors is None:
        return None
    localized = part.log.localization is not None
    estimated = estimates(settings, part.log.odometry is not None, localized)
    errors = replace(errors, estimated=frozenset(possible(part.log, settings) if estimated else ()))
    if not errors.harmful:
        return None
    after = agreement(part, errors.corrected(part.log), settings)
    return errors if after is not None and after.score > found.score + _GAIN else None


def _halves(part: Part, found: Agreement, settings: Settings) -> list[Finding]:
    """Return whether one half of the log fits worse than the other, or whether a camera was turned between them."""
    middle = float(np.median(found.keyframes.stamps))
    late = found.keyframes.stamps[found.rays.keyframe] > middle
    if min(late.sum(), (~late).sum()) < _FEWEST:
        return []
    differ = check_halves(late, found.point >= 0)
    if differ is not None:
        return [differ]
    windows: tuple[Ints, ...] = tuple(
        window + (window.max(initial=0) + 1) * (one.detections.frame_stamps > middle)
        if one.detections is not None
        else window
        for one, window in zip(part.log.cameras, part.window, strict=True)
    )
    apart = agreement(part, part.log, settings, windows)
    if apart is None:
        return []
    return _turned_cameras(part, apart, middle, windows, settings)


def _turned_cameras(
    part: Part, apart: Agreement, middle: float, windows: tuple[Ints, ...], settings: Settings
) -> list[Finding]:
    late = apart.keyframes.stamps[apart.rays.keyframe] > middle
    noise = pose_noise(part, settings)
    halves, gain = [], 0.0
    for mask in (~late, late):
        own = replace(apart, point=np.where(mask, apart.point, -1))
        half = find_small_errors(part.log, own, settings, noise, ("yaw", "tilt", "roll"))
        halves.append(half)
        after = None if half is None else agreement(part, half.corrected(part.log), settings, windows)
        if after is not None:
            gain += (
                after.fit[(after.keyframes.stamps[after.rays.keyframe] > middle) == mask[-1]].sum() - apart.fit[mask].sum()
            )
    if gain < _GAIN_MOVED * apart.boxes:
        return []
    results = []
    names = sorted({name for half in halves if half is not None for name in half.names})
    least = _MOVED_BY_ODOMETRY if part.drifts else _MOVED
    for name in names:
        values, variance = [], 0.0
        for half in halves:
            known = half is not None and name in half.names
            at = half.names.index(name) if half is not None and known else 0
            values.append(float(half.values[at]) if half is not None and known else 0.0)
            variance += float(half.sigma[at]) ** 2 if half is not None and known else 0.0
        change = values[1] - values[0]
        if abs(change) > max(least, _MOVED_SIGMAS * float(np.sqrt(variance))):
            results.append(
                Finding(
                    "camera moved",
                    f"{name} changes by {np.degrees(change):.1f} deg between the halves of the log: "
                    "somebody moved the camera on the robot",
                    basis="halves",
                )
            )
    return results
