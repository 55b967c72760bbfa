"""Run all checks of the input of a log: the checks of the log itself, and the checks of how well its boxes agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.known_errors import coarse, estimates, possible
from objslam.frontend.localization.localization_jumps import Jumps
from objslam.mapping.checks.agreement import Agreement, Part, agreement, agreements, bounded_part, pose_noise
from objslam.mapping.checks.boxes import check_boxes, refuse_shares
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.disagreement import disagree
from objslam.mapping.checks.hypotheses.every import later
from objslam.mapping.checks.hypotheses.lens import check_lens
from objslam.mapping.checks.hypotheses.trials import Trial, crooked, try_hypotheses, verdict
from objslam.mapping.checks.jumps import corrected_jumps, taken_out, wrong_jumps
from objslam.mapping.checks.parts.halves import check_halves
from objslam.mapping.checks.parts.mixture import check_mixture
from objslam.mapping.checks.parts.moved_camera import check_moved_camera
from objslam.mapping.checks.path import check_path
from objslam.mapping.checks.ranges import check_ranges
from objslam.mapping.checks.small_errors import SmallErrors, find_small_errors, with_clock
from objslam.mapping.checks.stamps import check_stamps
from objslam.mapping.checks.usual_errors import without_usual_errors
from objslam.mapping.progress import Progress

_ALARM = 0.6
"""The score (`Agreement.score`) at poses of a localisation below which a run tries hypotheses. With wrong input, most boxes
may still fit, but only with several points for each thing. Each point costs a part of the score. At poses by odometry, each
window needs its own point for each thing. So the share of fitting boxes is compared there, not the score. With a larger
value, more runs take a few seconds longer."""
_FITTING = 0.82
"""The mean fit (`Agreement.fit`) of the fitting boxes below which a run tries hypotheses. Gaussian noise gives 0.9. With a
larger value, more runs take a few seconds longer."""
_ALARM_CLOCKS = (-1.0, -0.5, 0.5, 1.0)
"""The clock offsets (s) that every run tries. A clock with a larger error also fits better with one of the offsets."""
_CROWD = 5.0
"""The largest crowd (`Part.crowd`) of a log whose boxes are compared. In a larger crowd, rays meet anywhere and show
nothing. With a larger value, more logs are compared, which takes longer."""
_FEWEST = 60
"""The fewest boxes of a log, or of one of its halves, that are judged by their agreement. Fewer boxes agree by chance. A
larger number judges fewer logs."""
_CLOCKS = (-0.3, -0.15, 0.15, 0.3)
"""The clock offsets (s) that are tried besides 0. The search for small errors starts from the offset that fits best. More
offsets take longer."""
_GAIN = 0.02
"""The least growth of the score that shows an error. The score grows by a clock offset of `_CLOCKS`, or by the removal of
errors that the run does not estimate. A larger value reports fewer errors."""


@dataclass(frozen=True)
class Diagnosis:
    """The faults of a log.

    findings: the faults. trials: the tried hypotheses, empty if none were tried. The first trial is the unchanged log.
    errors: small errors of the calibration that a run does not correct, None if there are none. jumps: the jumps of the
    localisation that a run takes out, None if there are none. uncompared: why the boxes were not compared with each other,
    "" if they were compared.
    """

    findings: tuple[Finding, ...] = ()
    trials: tuple[Trial, ...] = ()
    errors: SmallErrors | None = None
    jumps: Jumps | None = None
    uncompared: str = ""

    @property
    def spoilt(self) -> bool:
        """Whether the input makes all positions of the map unreliable."""
        return any(finding.spoils for finding in self.findings)

    @property
    def certain(self) -> bool:
        """Whether the log itself shows that the input is wrong, so that no solve can refute it."""
        return any(finding.spoils and finding.basis == "log" for finding in self.findings)

    def proven(self) -> Self:
        """Return the diagnosis with only the findings that the log itself shows."""
        return replace(self, findings=tuple(finding for finding in self.findings if finding.basis == "log"))

    def without(self, name: str) -> Self:
        """Return the diagnosis without the findings of this name."""
        return replace(self, findings=tuple(finding for finding in self.findings if finding.name != name))

    @property
    def refutable(self) -> bool:
        """Whether a solve that explains the boxes may refute one of the findings."""
        return any(finding.basis != "log" for finding in self.findings)

    def with_findings(self, more: Sequence[Finding]) -> Self:
        """Return the diagnosis with more findings."""
        return replace(self, findings=(*self.findings, *more))


def diagnose(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    progress: Progress = lambda stage, done, total: None,
    *,
    thorough: bool = False,
) -> Diagnosis:
    """Return the diagnosis of a log. thorough: whether to try hypotheses even if all looks right.

    ledger: the ledger of the reading of the log. Raises a LogError if the stamps are not in s, or the boxes are not in px.
    """
    jumps = wrong_jumps(log, settings)
    found = _diagnosed(taken_out(jumps, log), settings, ledger, progress, thorough=thorough)
    return found if jumps is None else replace(found, findings=(corrected_jumps(jumps), *found.findings), jumps=jumps)


def _diagnosed(log: Log, settings: Settings, ledger: Ledger, progress: Progress, *, thorough: bool) -> Diagnosis:
    """Return the diagnosis of a log without jumps. The arguments are as in `diagnose`."""
    if log.localization is None and log.odometry is None:
        return Diagnosis()
    refuse_shares(log)
    stamps = check_stamps(log)
    if stamps is not None and stamps.spoils:
        raise LogError(stamps.message, where=log.name, hint="write all stamps in s")
    of_path = check_path(log, settings)
    impossible = any(finding.spoils for finding in of_path)
    findings = [*([stamps] if stamps else []), *of_path, *check_boxes(log, ledger)]
    if not any(len(c.detections.frame_stamps) for c in log.cameras if c.detections is not None):
        return Diagnosis(tuple(findings), uncompared="there are no boxes")
    part = bounded_part(log, settings)
    if log.localization is not None and coarse(settings):
        return Diagnosis(tuple(findings), uncompared="the settings say that the localisation errs by much (localization.xy)")
    if part.crowd > _CROWD:
        return Diagnosis(tuple(findings), uncompared="there are so many things of one label that their rays meet anywhere")
    found = agreement(part, part.log, settings)
    trials: list[Trial] = []
    if part.boxes >= _FEWEST:
        odd = bool(findings) or crooked(log) or _misfits(part, found, settings)
        if thorough or (odd and not impossible):
            trials = try_hypotheses(part, log, found, settings, progress)
            named = None if impossible else verdict(trials, part, *_corrected(part, found, settings))
            if named is not None:
                return Diagnosis((named, *findings), tuple(trials))
    errors: SmallErrors | None = None
    few = "" if part.boxes >= _FEWEST else f"there are only {part.boxes} of them, and {_FEWEST} are needed"
    if impossible:  # Boxes at such poses agree with anything by chance.
        return Diagnosis(tuple(findings), tuple(trials), uncompared=few)
    if found is not None and part.boxes >= _FEWEST:
        doubted = bool(trials) and not part.drifts and not any(one.spoils for one in findings)
        doubted &= len(found.rays) >= _FEWEST
        none_fits = doubted and disagree(without_usual_errors(part, found, settings)[0], trials, part, settings)
        # If no hypothesis fits, the boxes agree only by chance. They then say nothing about single frames, about halves, or
        # about the rotation of a camera.
        findings += [none_fits] if none_fits else _parts_differ(part, found, settings)
        lens = None if none_fits else check_lens(part, found, settings)
        if lens is not None:
            findings.append(lens[0])
            trials.append(lens[1])
        elif not any(finding.spoils for finding in findings):
            errors = _small_errors(part, found, settings)
            if errors is not None:
                cause = f"at the given poses the boxes fit best with {errors.in_words()}: {errors.causes()}"
                # The objects get the covariance that such an error causes.
                findings.append(Finding("calibration", f"{cause} ({errors.remedy(settings)} estimates it)", spoils=False))
        ranges = check_ranges(found, part)
        findings += [ranges] if ranges else []
    return Diagnosis(tuple(findings), tuple(trials), errors, uncompared=few)


def _misfits(part: Part, found: Agreement | None, settings: Settings) -> bool:
    """Return whether few boxes fit, whether the fitting boxes fit poorly, or whether another clock fits better."""
    if found is None or (found.share if part.drifts else found.score) < _ALARM:
        return True
    if found.fit.sum() < _FITTING * (found.point >= 0).sum():
        return True
    trials = agreements(part, (later(part.log, offset) for offset in _ALARM_CLOCKS), settings)
    return any(trial is not None and trial.score > found.score for trial in trials)


def _corrected(part: Part, found: Agreement | None, settings: Settings) -> tuple[float, str]:
    """Return the score of a log after its small errors are removed, and the errors that are too large for a usual camera.

    The second value lists these errors in words. The small errors are those that a run in this mode estimates at given
    poses. Without such errors, the score is 0 and the words are "".
    """
    estimated = _estimated(part, settings)
    if found is None or part.drifts or settings.mode == "joint" or not estimated:
        return 0.0, ""
    errors = find_small_errors(part.log, found, settings, pose_noise(part, settings))
    after = None if errors is None else agreement(part, errors.corrected(part.log, estimated), settings)
    if errors is None or after is None:
        return 0.0, ""
    return after.score, replace(errors, estimated=estimated).unusual(settings)


def _estimated(part: Part, settings: Settings) -> frozenset[str]:
    """Return the names of the errors that a run estimates."""
    wanted = estimates(settings, part.log.odometry is not None, part.log.localization is not None)
    return frozenset(possible(part.log, settings) if wanted else ())


def _small_errors(part: Part, found: Agreement, settings: Settings) -> SmallErrors | None:
    """Return small errors that need a warning, because a run in this mode does not estimate them."""
    if part.drifts or settings.mode == "joint":
        return None
    noise = pose_noise(part, settings)
    start, best, log = found, 0.0, part.log
    logs = [later(part.log, offset) for offset in _CLOCKS]
    trials = agreements(part, logs, settings)
    for offset, moved, trial in zip(_CLOCKS, logs, trials, strict=True):
        # With a large clock error, the rays that would show the error do not fit.
        if trial is not None and trial.score > start.score + _GAIN:
            start, best, log = trial, offset, moved
    errors = find_small_errors(log, start, settings, noise)
    if best:
        errors = with_clock(errors, best, part.log, found, settings)
    if errors is None:
        return None
    errors = replace(errors, estimated=_estimated(part, settings))
    if not errors.harmful:
        return None
    # An error that the run corrects itself is no reason for a warning. So only the gain by the harmful errors counts.
    corrected = errors.corrected(part.log, errors.estimated), errors.corrected(part.log)
    before, after = agreements(part, corrected, settings)
    least = found.score if before is None else max(found.score, before.score)
    return errors if after is not None and after.score > least + _GAIN else None


def _parts_differ(part: Part, found: Agreement, settings: Settings) -> list[Finding]:
    """Return findings about parts that differ: some frames fit worse than others, one half fits worse than the other, or
    somebody turned a camera."""
    middle = float(np.median(found.keyframes.stamps))
    late = found.keyframes.stamps[found.rays.keyframe] > middle
    long = bool(min(late.sum(), (~late).sum()) >= _FEWEST)

    def differ(at: Agreement) -> Finding | None:
        return check_mixture(at, part) or _halves_differ(at, middle)

    one = differ(found)
    if one is not None and not part.drifts:
        # The robot does not turn equally fast in all frames. So the boxes of some frames also fit badly if a clock is wrong.
        one = differ(without_usual_errors(part, found, settings)[0])
    if one is not None:
        return [one]
    return check_moved_camera(part, middle, settings) if long else []


def _halves_differ(found: Agreement, middle: float) -> Finding | None:
    """Return a finding if the halves before and after the time `middle` (s) differ. Only rays that can fit or miss count."""
    late = (found.keyframes.stamps[found.rays.keyframe] > middle)[~found.narrow]
    if min(late.sum(), (~late).sum()) < _FEWEST:
        return None
    return check_halves(late, found.point[~found.narrow] >= 0)
