"""Findings that the solve refutes: a joint solve may correct what a quick look at the boxes takes for wrong input.

The quick look holds the odometry and the calibration as they are, for some seconds each. A camera that is turned by some
degrees and late by a tenth of a second lets few boxes fit then.
"""

from dataclasses import replace

import numpy as np

from objslam.mapping.alternation import Solution
from objslam.mapping.checks.diagnosis import Diagnosis

_EXPLAINED = 0.85
"""The share of the rays in each half of a log that the solve must explain to refute a finding. A larger share refutes fewer.
Clean simulated logs have 0.92 and more, logs with one of 20 kinds of wrong boxes, cameras or clocks at most 0.76."""
_NOISE = 2.0
"""The largest noise of the rays, times that of the settings, with which this counts. With enough noise all rays fit."""


def without_refuted(diagnosis: Diagnosis, solution: Solution) -> Diagnosis:
    """Return the diagnosis without the findings that rest on the boxes alone, if a joint solve explains the boxes.

    Where labels do not name the objects, an object that is there twice explains boxes as well. So then a difference between
    the halves of the log is not refuted.
    """
    estimate, rays = solution.estimate, solution.rays
    if not diagnosis.refutable:
        return diagnosis
    stamps = solution.keyframes.stamps[rays.keyframe]
    late = stamps > np.median(stamps)
    explained = (estimate.weight > 0) & (solution.association.object >= 0)
    noisy = estimate.noise is not None and estimate.noise.rays > _NOISE
    if noisy or not late.any() or min(explained[late].mean(), explained[~late].mean()) < _EXPLAINED:
        return diagnosis
    named = not solution.rounds
    kept = tuple(one for one in diagnosis.findings if not one.by_boxes or (one.by_halves and not named))
    return replace(diagnosis, findings=kept)
