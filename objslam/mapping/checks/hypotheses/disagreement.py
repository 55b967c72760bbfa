"""Detect boxes that agree with the poses only by chance, as they would with a wrong mount of the camera."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools
from objslam.mapping.checks.agreement import Agreement, Part, agreements
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.every import later, with_headings
from objslam.mapping.checks.hypotheses.mounts import unset
from objslam.mapping.checks.hypotheses.trials import Trial, chance

DISAGREE = "boxes disagree"
"""The name of the finding that the boxes and the poses disagree, and no hypothesis explains why."""
_BAD_SCORE = 0.5
"""The score below which boxes may disagree with the poses. It is the score of the boxes with a ray. Logs of usual detectors
have at least 0.56. Logs with turned cameras have at most 0.5, unless they show little parallax. The finding accuses 11 of
119 simulated robots with right cameras whose boxes fit poorly, mostly because of many false boxes. It accuses 47 of 56
turned cameras. At 0.4, the finding accuses 8 robots and 44 cameras. A larger score accuses more logs."""
_HARDLY = 0.1
"""The score below which boxes disagree, whatever the score by chance is. A larger score accuses more logs."""
_TIMES = 2.0
"""The multiple of the score by chance (`trials.chance`) below which boxes agree only by chance. Clean logs have at least 2.9
times the score by chance, and logs with turned cameras at most 1.9 times. A larger value accuses more logs."""
_DISTANT = 0.9
"""The share of the rays that fit a point or a direction, from which the boxes agree with the poses. The share is at least
0.94 in logs without parallax, and at most 0.8 with turned cameras. A larger share accuses more logs."""
_CONE = np.radians(4.0)
"""The largest angle (rad) between rays that count as one direction. Such rays give no point. A larger angle accuses fewer
logs."""
_PILE = 0.2
"""The least share of a label's rays that show one distant thing. A smaller share of the rays may have one direction by
chance. A larger share accuses more logs."""
_TURNS, _CLOCKS = (-24.0, -12.0, 12.0, 24.0), (-1.0, -0.5, 0.5, 1.0)
"""The turns of all headings (degrees) and the offsets of the frames' clock (s) with which a log is compared. Each is too
large to fit a right log. With more turns and offsets, wrong input more rarely fits best as it is given."""
_PEAK = 0.8
"""The largest score with a turn or a clock offset of right input, as a share of the score of the log as it is given. Right
logs have at most 0.75. The largest values are from a simulated drive in a hospital with many people, and from two drives of
cars with GPS, whose poses err by far more than the settings say. Logs with turned cameras, wrong clocks, or the poses of
another drive have at least 0.9. Logs with mirrored paths have 0.62 to 0.91, so only a hypothesis with a higher score shows a
mirrored path. A larger share accuses fewer logs."""
_TRIED = 64  # The most directions that are tried for a distant thing. A larger number finds smaller piles.


def disagree(found: Agreement, trials: list[Trial], part: Part, settings: Settings) -> Finding | None:
    """Return a finding if the boxes agree with the poses only by chance, although they would show parallax.

    found: the agreement after a correction of the usual errors of the cameras, from `without_usual_errors`. trials: the
    trials of all hypotheses. The first is of the unchanged log. The turned mounts among them show the score by chance in
    this log. Things that are too far for parallax give no point, but each thing has one direction. Boxes without a ray, such
    as those that the image's edge cuts off, do not count. If the log fits best as it is given (`_fits_best`), noise and
    things that move lower the score, and the boxes do not agree by chance.
    """
    by_chance = chance(trials)
    rays = len(found.rays)
    if by_chance is None or not rays:
        return None
    every = found.boxes / rays
    if every * found.score >= min(_BAD_SCORE, max(every * _TIMES * by_chance, _HARDLY)):
        return None
    if _at_rest(found).sum() >= _DISTANT * rays or _fits_best(trials, part, settings):
        return None
    message = (
        f"only {100 * every * found.share:.0f} % of the boxes agree with the poses, hardly more than with a camera that is "
        "turned at random, and no usual mistake explains that: look at base_T_camera, at the frame of the poses and at the "
        "stamps. Perhaps the poses are of another drive, or they err by far more than localization.xy, or the depths err by "
        "far more than depth.sigma_per_m"
    )
    if unset(part.log):
        message += ". base_T_camera has no rotation, so the camera looks where z of the poses points"
    return Finding(DISAGREE, message, basis="boxes")


def _fits_best(trials: list[Trial], part: Part, settings: Settings) -> bool:
    """Return whether the boxes of a log fit best as the log is given. Wrong input has no reason to fit best.

    No hypothesis may have a higher score, and small turns of the robot and small clock offsets must all lower the score.
    """
    given = trials[0].score
    if any(trial.score > given for trial in trials[1:]):
        return False
    changed = [with_headings(part.log, turn) for turn in _TURNS] + [later(part.log, offset) for offset in _CLOCKS]
    scores = [0.0 if one is None else one.score for one in agreements(part, changed, settings)]
    return max(scores) <= _PEAK * given


def _at_rest(found: Agreement) -> Bools:
    """Return which rays (R,) fit a point, or show a distant thing: many rays of one label that have the same direction."""
    fits = found.point >= 0
    directions = found.rays.in_map(found.keyframes.map_T_camera)[1]
    for label in np.unique(found.rays.label).tolist():
        mine = np.flatnonzero(found.rays.label == label)
        least = _PILE * len(mine)
        left = mine[~fits[mine]]
        while len(left) >= least and len(left):
            some = np.linspace(0, len(left) - 1, min(_TRIED, len(left))).astype(int)
            near = directions[left] @ directions[left[some]].T > np.cos(_CONE)
            pile = near[:, near.sum(axis=0).argmax()]
            if pile.sum() < least:
                break
            fits[left[pile]] = True
            left = left[~pile]
    return fits
