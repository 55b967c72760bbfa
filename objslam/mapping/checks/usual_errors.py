"""Measure how well boxes agree after the usual errors of the cameras are corrected, as far as the boxes show them.

A check that looks at given poses must not take such errors for a fault: a run estimates them.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.frontend.corrected_log import take_out
from objslam.frontend.shared_errors import SharedErrors
from objslam.graph.calibration.fixed_pose_calibration import calibrate_at_poses
from objslam.mapping.checks.agreement import Agreement, Part, agreement, pose_noise
from objslam.mapping.checks.small_errors import shared

_PRIORS = {"clock": 0.1, "yaw": 0.03, "tilt": 0.02, "roll": 0.02, "translation": 0.05, "focal": 0.02, "centre": 0.02}
"""The prior standard deviations (s, rad, m, share) of usual errors: the defaults of a run in fixed mode. With larger values,
a fault looks more like such errors."""
_ROUNDS = 4
"""The most rounds of fitting points and estimating errors. With large errors, only some rays fit at first, and the errors by
these rays are too small. More rounds are more exact and take longer."""
_SETTLED = 0.5
"""The largest change of an error at which the rounds end, in its standard deviations. A smaller value is more exact and
takes longer. The score cannot tell when to end, because the score may grow only when nearly all rays fit."""


def without_usual_errors(
    part: Part,
    start: Agreement,
    settings: Settings,
    prior: Callable[[SharedErrors], Floats] = lambda errors: errors.prior,
    goes_on: Callable[[Calibration], bool] = lambda found: True,
    known: Calibration | None = None,
) -> tuple[Agreement, Calibration | None]:
    """Return the agreement with the best score and the last errors of rounds that fit points and estimate the errors.

    start: the agreement of the part as it is. prior: returns the covariance (P, P) of the errors before the estimate.
    goes_on: whether the errors of a round are worth another round. known: errors from which the first round starts, so that
    `start` is the agreement without them. If no round could estimate the errors, the returned errors are `known`.
    """
    best, now = start, start
    for _ in range(_ROUNDS):
        errors = shared(part.log, now.keyframes, now.rays, settings, _PRIORS)
        total = np.zeros(len(errors.names)) if known is None else known.values
        # The rays are corrected already, so the prior expects that the rest cancels the correction.
        errors = replace(errors, prior=prior(errors), mean=-total)
        label = np.zeros(len(now.points), dtype=np.int64)
        noise = pose_noise(part, settings)
        try:
            at = Association(now.point, label)
            found = calibrate_at_poses(errors, at, now.points, 0.0 * total, noise, trusted=False).calibration
        except SolveError:
            break
        known = replace(found, values=total + found.values)
        if not goes_on(known):
            break
        log = take_out(part.log, dict(zip(known.names, known.values.tolist(), strict=True)), stay=True)
        after = agreement(part, log, settings)
        if after is None:
            break
        now, best = after, after if after.score > best.score else best
        if (np.abs(found.values) < _SETTLED * found.sigma).all():
            break
    return best, known
