"""Remove the shared errors that a solve estimated from its log."""

from dataclasses import replace

from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.checks.shared_errors import warn_of_large_errors, warn_of_noisy_labels
from objslam.mapping.solution import Solution, with_noise_of


def corrected(solution: Solution, errors: SharedErrors, ledger: Ledger) -> tuple[Solution, Log]:
    """Return a solution and its log without the shared errors, for example clock offsets. The ledger warns of large errors.

    errors: the errors that the solve estimated. The returned solution also has the prior of these errors in its calibration,
    and the odometry's drift at each keyframe.
    """
    if solution.estimate.noise is not None:
        warn_of_noisy_labels(solution.estimate.noise, ledger)
    calibration = solution.estimate.calibration
    if calibration is None:
        return solution, errors.log
    calibration = errors.with_prior(calibration)
    warn_of_large_errors(calibration, ledger)
    timed = with_noise_of(errors, solution.estimate).drift_at_stamps(solution.keyframes, calibration.values)
    solution = replace(solution, keyframes=timed, estimate=replace(solution.estimate, calibration=calibration))
    return solution, errors.corrected_log(calibration.values)
