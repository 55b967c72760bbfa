"""Try hypotheses about wrong input on a part of a log, and name the hypothesis that explains the log much better."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.types import Log
from objslam.mapping.checks.agreement import Agreement, Part, agreements
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.every import hypotheses
from objslam.mapping.checks.hypotheses.hypothesis import Hypothesis
from objslam.mapping.checks.path import straightness
from objslam.mapping.progress import Progress

_TIMES, _MORE = 1.2, 0.06
"""The least factor and the least difference by which a hypothesis must raise the score. Larger values name fewer causes."""
_CROWD = 1.4
"""The crowd (`Part.crowd`) above which rays meet by chance. The unnamed posts of the MRCLAM robots have 1.9. With a larger
value, fewer logs need the larger limits below."""
_CROWD_TIMES, _CROWD_MORE = 2.0, 0.25
"""The values of `_TIMES` and `_MORE` in a crowd above `_CROWD`. Larger values name fewer causes."""
_MORE_BOXES = 25
"""The least number of additional boxes that must fit. A larger number needs longer logs."""
_CROOKED, _STRAIGHT = 0.62, 0.85
"""The straightness of a path below which its axes may be wrong, and the straightness that corrected axes must exceed. In
real logs, hand-held cameras have 0.68 and more, wheels 0.94, and wrong axes at most 0.59. A larger first value suspects more
paths. A larger second value accepts fewer corrections."""
_NOT_WORSE = 0.8
"""The least share of the score that a hypothesis about the axes of a path must keep. In sparse logs, boxes hardly depend on
the axes. A larger share accepts fewer corrections."""
_EQUAL = 0.95
"""The share of the best score from which another hypothesis is as good as the best. A larger share names fewer
alternatives."""
_HALF = 0.5
"""The least share of fitting boxes of a hypothesis about a log with a localisation. A hypothesis with fewer fitting boxes
fits by chance: the right hypothesis lets 0.9 of the boxes fit. A larger share names fewer causes."""
_RIVAL = 0.02
"""A mount explains the boxes as well as an unusual error if its score is lower by at most this value. Two fits of one log
with different random pairs differ by as much. A larger value names more mounts."""

_BOTH_WAYS = 0.8
"""An earlier and a later clock contradict each other if the lower of their scores is at least this share of the higher one.
A camera has only one clock error. In simulated logs with a wrong clock, no shift in the other direction has more than 0.61
of the best score. A smaller share names fewer clocks."""
_CHANCE = 90.0
"""The score by chance is this percentile of the scores of all turned mounts. With a larger percentile, more agreement counts
as chance."""
_LEFT, _TIMES_CHANCE = 0.62, 1.5
"""The limits of two tests that compare a hypothesis with turned mounts, which fit by chance. The tests apply at poses of a
localisation. A hypothesis must pass one of them. Its misfit (1 - score) must be at most the share `_LEFT` of the misfit by
chance, or its score at least `_TIMES_CHANCE` times the score by chance. Noisy poses spoil a true fit, but hardly a fit by
chance. So a wrong hypothesis may fit better than the unchanged log. In 80 logs of 16 simulated robots with a mistake, the
right hypothesis leaves a share of at most 0.57. In noisy logs without a mistake, the best hypothesis leaves at least 0.68,
and has at most 1.36 times the score. A larger share and a smaller multiple name more causes."""
_BEYOND, _FAR_BETTER = 1.3, 1.5
"""The least scores of a clear mount, as multiples of the score by chance (`_BEYOND`) and of the score of the unchanged log
(`_FAR_BETTER`). Logs of five kinds of simulated robots and of three real robots were tried, with odometry alone and a turned
camera. The right turn has 1.2 to 3.7 times the score by chance, mostly more than 1.4. No mount has more than 1.34 times the
score of a clean log. Larger multiples keep fewer findings that no solve supports."""


@dataclass(frozen=True)
class Trial:
    """The test of a hypothesis.

    hypothesis: None for the unchanged log. score, share: as in `Agreement`. straight: as returned by `path.straightness`,
    None if unknown. seen: the share of the boxes that the image's edge does not cut off.
    """

    hypothesis: Hypothesis | None
    score: float
    share: float
    straight: float | None
    seen: float = 1.0

    @property
    def of_whole(self) -> float:
        """The score without the boxes that the image's edge cuts off."""
        return self.score / self.seen if self.seen > 0 else 0.0


def try_hypotheses(part: Part, log: Log, before: Agreement | None, settings: Settings, progress: Progress) -> list[Trial]:
    """Return the trial of the unchanged log, followed by the trials of all hypotheses, from the best to the worst."""
    first = _unchanged(before, log)
    every = list(hypotheses(part.log))

    def corrected() -> Iterator[Log]:
        for number, hypothesis in enumerate(every):
            progress("possible corrections of the input", number, len(every))
            logs.append(hypothesis.put_right(part.log))
            yield logs[-1]

    logs: list[Log] = []
    trials = []
    for number, found in enumerate(agreements(part, corrected(), settings)):
        changed = logs[number]
        of_path = changed.localization is not part.log.localization or changed.odometry is not part.log.odometry
        straight = _straight(changed) if of_path else first.straight
        score, share, seen = (found.score, found.share, _seen(found)) if found else (0.0, 0.0, 0.0)
        trials.append(Trial(every[number], score, share, straight, seen))
    return [first, *sorted(trials, key=lambda trial: -trial.score)]


def _unchanged(before: Agreement | None, log: Log) -> Trial:
    """Return the trial of the unchanged log. Boxes whose rays come from one direction count as fitting. So a hypothesis that
    makes these rays cross gains no boxes."""
    if before is None:
        return Trial(None, 0.0, 0.0, _straight(log))
    narrow = float(before.narrow.sum() / before.boxes)
    return Trial(None, before.score + narrow, before.share, _straight(log), _seen(before))


def _seen(found: Agreement) -> float:
    """Return the share of the boxes that the image's edge does not cut off."""
    return 1 - found.cut / max(found.boxes, 1)


def verdict(trials: list[Trial], part: Part, corrected: float, unusual: str = "") -> Finding | None:
    """Return a finding if a hypothesis explains the boxes, or the path, much better than the unchanged log.

    Two scores must be better: the score of all boxes, and the score without the boxes that the image's edge cuts off. Cut
    off boxes have no ray, so they cannot fit. If x and y of right boxes are swapped, many cut off boxes get a ray, and some
    fit by chance. A box with its centre outside the image has no ray either, but counts as a box that does not fit.

    corrected: the score of the log without the errors that a run estimates. A hypothesis must also explain the boxes much
    better than these errors do: a mount with another order of its quaternion may look like a mount that is tilted a little.
    unusual: the errors, in words, that are too large for a usual mount, "" if there are none. If there are such errors, a
    wrong mount that explains the boxes equally well is the more probable cause. The finding then names this mount. This
    finding does not spoil the map, because the run corrects the error.
    """
    first, rest = trials[0], trials[1:]
    by_chance = None if part.drifts else chance(rest)
    least_score = -np.inf if by_chance is None else min(1 - _LEFT * (1 - by_chance), _TIMES_CHANCE * by_chance)

    def holds(trial: Trial, before: float) -> bool:
        times, least = (_CROWD_TIMES, _CROWD_MORE) if part.crowd > _CROWD else (_TIMES, _MORE)
        whole = before / first.seen if first.seen > 0 else 0.0
        more = all(now > max(times * old, old + least) for now, old in ((trial.score, before), (trial.of_whole, whole)))
        more &= (trial.score - before) * part.boxes > _MORE_BOXES and (part.drifts or trial.share >= _HALF)
        more &= trial.score >= least_score
        # Better boxes are no reason to make a straight path crooked.
        return bool(more and not (_is_straight(first) and trial.straight is not None and trial.straight < _CROOKED))

    def straightens(trial: Trial) -> bool:
        return bool(_is_crooked(first) and (trial.straight or 0.0) > _STRAIGHT and trial.score >= _NOT_WORSE * first.score)

    def rivals(trial: Trial) -> bool:
        of_mount = trial.hypothesis is not None and trial.hypothesis.of_mount
        return of_mount and trial.score >= corrected - _RIVAL and holds(trial, first.score)

    good = [trial for trial in rest if straightens(trial)]
    good = good or [trial for trial in rest if holds(trial, max(first.score, corrected))]
    taken = not good and bool(unusual)
    good = good or [trial for trial in rest if taken and rivals(trial)]
    if not good:
        return None
    clocks = _both_ways(good)
    if clocks:
        # A hypothesis that fits hardly better than two contradictory clocks fits by chance, like these clocks.
        good = [trial for trial in good if trial not in clocks and _EQUAL * trial.score > clocks[0].score]
    if not good:
        return _of_another_drive(first, clocks[0])
    equal = [trial for trial in good if trial.score >= _EQUAL * good[0].score]
    equal = [trial for trial in equal if trial.hypothesis is not None and trial.hypothesis.usual] or equal
    best = equal[0]
    assert best.hypothesis is not None
    causes = list(dict.fromkeys(trial.hypothesis.cause for trial in equal if trial.hypothesis is not None))[:3]
    fit = f"{100 * best.share:.0f} % of the boxes fit instead of {100 * first.share:.0f} %"
    if _is_crooked(first) and best.straight is not None and best.straight > _STRAIGHT:
        fit += ", and the robot drives where it heads"
    message = f"with {best.hypothesis.what}, {fit}: {', or '.join(causes)}"
    if taken:
        message += f". The run takes this error for {unusual}, and corrects it"
    return Finding(best.hypothesis.name, message, spoils=not taken, basis="log" if _is_crooked(first) else "boxes")


def _both_ways(good: Sequence[Trial]) -> list[Trial]:
    """Return the trials with another clock, if earlier and later clocks fit about equally well. Return no trials otherwise.
    The best trial comes first."""
    clocks = [trial for trial in good if _shift(trial)]
    earlier, later = (max((t.score for t in clocks if sign * _shift(t) > 0), default=0.0) for sign in (-1, 1))
    return clocks if clocks and min(earlier, later) >= _BOTH_WAYS * max(earlier, later) else []


def _shift(trial: Trial) -> float:
    return 0.0 if trial.hypothesis is None else trial.hypothesis.clock


def _of_another_drive(first: Trial, best: Trial) -> Finding:
    """Return the finding of a log whose boxes fit better at other times. best: the best trial with another clock."""
    message = (
        f"only {100 * first.share:.0f} % of the boxes agree with the poses. Earlier and later stamps of the frames both "
        f"raise this share, to up to {100 * best.share:.0f} %, so no error of the clock explains it: the poses may be of "
        "another drive than the boxes"
    )
    return Finding("boxes disagree", message, basis="boxes")


def chance(trials: Sequence[Trial]) -> float | None:
    """Return the score that boxes reach by chance in this log, None if no mounts were tried.

    A tenth of all turned mounts have a higher score (`_CHANCE`). At most one mount is right.
    """
    turned = [trial.score for trial in trials if trial.hypothesis is not None and trial.hypothesis.of_mount]
    return float(np.percentile(turned, _CHANCE)) if turned else None


def clear(trials: Sequence[Trial], name: str) -> bool:
    """Return whether a mount is far better than the unchanged log and far better than chance. name: the name of the mount's
    hypothesis."""
    by_chance = chance(trials)
    scores = [t.score for t in trials if t.hypothesis is not None and t.hypothesis.of_mount and t.hypothesis.name == name]
    return by_chance is not None and max(scores, default=0.0) >= max(_BEYOND * by_chance, _FAR_BETTER * trials[0].score)


def crooked(log: Log) -> bool:
    """Return whether the directions of a log's path do not fit its headings."""
    straight = _straight(log)
    return straight is not None and straight < _CROOKED


def _is_crooked(trial: Trial) -> bool:
    return trial.straight is not None and trial.straight < _CROOKED


def _is_straight(trial: Trial) -> bool:
    return trial.straight is not None and trial.straight > _STRAIGHT


def _straight(log: Log) -> float | None:
    path = log.localization or log.odometry
    return None if path is None else straightness(path)
