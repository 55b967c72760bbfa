"""Calibrate the cameras at known poses. The calibration alternates with the search for objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import Calibration, expected_errors
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import angles_off
from objslam.core.statistics import STRAY_RAY
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Log
from objslam.errors import SolveError
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.fixed.fixed_poses import MOST_ROUNDS, SAME, FixedPoses, placed_objects, with_noise_of
from objslam.mapping.progress import Progress
from objslam.mapping.solution import Solution

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.graph.calibration.fixed_pose_calibration import FixedCalibration

_NARROWER = (0.3, 0.0)
"""The shares of the uncertainty of the shared errors for which narrower first associations allow. They are tried if a log
fits poorly. Each share takes the time of one association."""
_FITS = 2.0
"""The largest mean squared miss of a ray, in variances of its noise, at which the widest association is taken without a
trial of others. Rays with the noise of the settings have 2, because they have two axes. With a larger value, fewer logs take
the time for other associations, but rows of equal things are confused more often."""
_CLEARLY = 1.75
"""The least amount by which a narrower association must lower the misfit to be taken. The misfit is the mean over all rays
of -2 ln of their probability. In simulated orchards and shelves, the right association lowers the misfit by 2.1 to 6.1. If
the poses err for seconds, one thing may look like several. A wrong association then lowers the misfit by up to 1.4. With a
smaller value, noisy poses split more things."""


def calibrate_fixed(
    at: FixedPoses,
    errors: SharedErrors,
    ledger: Ledger,
    progress: Progress,
    trace: Trace | None,
) -> tuple[FixedPoses, Association, Estimate, tuple[dict[str, int], ...]]:
    """Estimate the shared errors of cameras at known poses. The estimate alternates with the association and the solve of
    objects.

    Each association allows for the present uncertainty of the errors. This is first their prior, and then the covariance of
    the last fit. In rows of equal things, it is only the part of the uncertainty that moves rays off their objects. The
    errors may still change after two associations, or after one in rows of equal things. Then the next associations begin
    with the known objects, because a search among all rays takes long, and each search finds a few other objects. When the
    errors no longer change, there is one more search among all rays. The covariance of the errors is added to the covariance
    of the objects. Return the input without the errors, the association, the estimate, and the number of objects in each
    round. If the errors cannot be estimated, they stay as they were, and the ledger gets a warning.
    """
    from objslam.graph.calibration.fixed_pose_calibration import (
        calibrate_at_poses,
        noise_beside_objects,
        noise_of_errors,
        turned_by_errors,
    )
    from objslam.graph.fixed_pose_triangulation import largest_noise

    calibration = expected_errors(errors)
    every = errors.take(at.frames, at.rays)
    told = noise_of_errors(every, calibration)
    rounds: tuple[dict[str, int], ...] = ()
    earlier: list[tuple[Floats, Floats]] = []
    in_rows = settled = False
    guess: tuple[Association, Floats] | None = None  # Without a guess, an association searches among all rays.
    now = at.without(errors, calibration.values)
    for number in range(MOST_ROUNDS):
        progress(f"association, round {number + 1}", 0, 0)
        if number:
            association = now.associate(told, guess)
            progress("solve", 0, 0)
            trial = _tried(at, now, errors, calibration, association, trace)
        else:
            trial, in_rows = _first_trial(at, now, errors, calibration, told, trace)
        association, estimate, found = trial.association, trial.estimate, trial.found
        rounds = (*rounds, {"objects": association.count})
        if trace is not None and trial.trace is not None:
            trace.take(trial.trace)
        if found is None:
            ledger.warn(f"the shared errors could not be estimated, and stay as they were: {trial.failure}")
            association, estimate = now.completed(association, estimate, trace, _parameters(calibration), told)
            return now, association, replace(estimate, calibration=calibration, uncalibrated=True), rounds
        earlier.append((calibration.values, np.hypot(_own(now), told)))
        calibration, now = found.calibration, trial.corrected
        # Wide gates also keep the rays of poses whose errors last. In rows of equal things, they keep rays of neighbours.
        told = (
            noise_beside_objects(errors, found, association, trial.moved) if in_rows else noise_of_errors(every, calibration)
        )
        at = at.with_noise_of_poses(now.seen.pose_noise)
        allowed = np.hypot(_own(at), told)
        turned = turned_by_errors(every, np.array([values for values, _ in earlier]), calibration.values)
        if any(
            _rms(angle / before) < SAME and _rms(allowed / before - 1) < SAME
            for angle, (_, before) in zip(turned, earlier, strict=True)
        ):
            if guess is None or settled:
                break
            guess, settled = None, True
        elif number or in_rows:
            guess = association, trial.moved
    else:
        ledger.warn(f"the shared errors still change after {MOST_ROUNDS} rounds of association")
    assert found is not None  # There is at least one round.
    progress("solve", 0, 0)
    estimate = now.solve(association, trace, _parameters(calibration))
    centred = _calibrated_by_centres(now, errors, association, estimate, calibration.values)
    if centred is not None:
        found, calibration, rounds = centred, centred.calibration, (*rounds, {"objects": association.count})
        now = at.without(errors, calibration.values)
        estimate = now.solve(association, trace, _parameters(calibration))
    calibrated = association
    association, estimate = now.completed(calibrated, estimate, trace, _parameters(calibration), told)
    if association is not calibrated:
        noise = largest_noise(now.seen, now.settings)
        sensitivity = calibrate_at_poses(
            errors, association, placed_objects(estimate), calibration.values, noise
        ).sensitivity
        found = replace(found, sensitivity=sensitivity)
    return now, association, with_noise_of(_with_covariance(estimate, found), now), rounds


def _calibrated_by_centres(
    now: FixedPoses, errors: SharedErrors, association: Association, estimate: Estimate, theta: Floats
) -> FixedCalibration | None:
    """Return the calibration by bearings to the centres of bodies. Return None if no body shifts its bearings enough.

    The box of a large thing nearby has its centre beside the image of the thing's centre. It lies in the same direction in
    all images. So the centres of boxes would tilt the camera, or move its image centre. now: the input at the errors theta
    (P,), with its estimate.
    """
    from objslam.graph.calibration.fixed_pose_calibration import calibrate_at_poses
    from objslam.graph.fixed_pose_triangulation import largest_noise
    from objslam.mapping.bodies.centre_bearings import worth_turning
    from objslam.mapping.bodies.fitting import with_bodies

    solution = Solution(now.seen, now.rays_seen, association, estimate, ())
    shift = with_bodies(solution, now.cameras, now.settings).to_centre
    if shift is None or not worth_turning(shift, now.rays_seen.sigma, association).any():
        return None
    turned = replace(errors, rays=shift.only(estimate.weight > 0).apply(errors.rays))
    noise = largest_noise(now.seen, now.settings)
    try:
        return calibrate_at_poses(turned, association, placed_objects(estimate), theta, noise)
    except SolveError:  # The calibration by the centres of boxes stays.
        return None


def associate_at_poses(at: FixedPoses, log: Log, progress: Progress) -> Association | None:
    """Return the association of the fixed mode, at known poses and calibrated cameras. Return None if no error is to be
    calibrated.

    at: the input as measured. Its mode does not matter.
    """
    at = replace(at, settings=at.settings.model_copy(update={"mode": "fixed"}))
    errors = shared_errors(log, at.seen, at.rays_seen, at.settings)
    return None if errors is None else calibrate_fixed(at, errors, Ledger(), progress, None)[1]


@dataclass(frozen=True)
class _Trial:
    """An association at some values of the shared errors, and the calibration by it.

    estimate: the objects at these values. found: the calibration by these objects, None if it failed. failure: why it
    failed, else None. moved: (N, 3) m, the positions of the objects at the calibrated errors, NaN without a position.
    corrected: the input at the calibrated errors, with the noise of the poses that the rays show. trace: the record of the
    estimate, None if nothing is recorded.
    """

    association: Association
    estimate: Estimate
    found: FixedCalibration | None
    failure: SolveError | None
    moved: Floats
    corrected: FixedPoses
    trace: Trace | None

    def left(self) -> tuple[float, float]:
        """Return the two values of `_left` after the calibration. They are infinite without a calibration."""
        if self.found is None:
            return float("inf"), float("inf")
        return _left(self.corrected, self.association, self.moved)


def _tried(
    at: FixedPoses,
    now: FixedPoses,
    errors: SharedErrors,
    calibration: Calibration,
    association: Association,
    trace: Trace | None,
) -> _Trial:
    """Solve the objects of an association, and calibrate the errors by them.

    at, now: the input as measured, and corrected for `calibration.values`.
    """
    from objslam.graph.calibration.fixed_pose_calibration import calibrate_at_poses
    from objslam.graph.fixed_pose_triangulation import largest_noise

    attempt = None if trace is None else trace.aside()
    estimate = now.solve(association, attempt, _parameters(calibration))
    placed, noise = placed_objects(estimate), largest_noise(now.seen, now.settings)
    try:
        found = calibrate_at_poses(errors, association, placed, calibration.values, noise)
    except SolveError as error:
        return _Trial(association, estimate, None, error, placed, now, attempt)
    moved = placed + found.sensitivity @ (found.calibration.values - calibration.values)
    then = at.without(errors, found.calibration.values)
    then = then.with_noise_of_poses(then.noise_of_poses(association, moved, estimate.weight))
    return _Trial(association, estimate, found, None, moved, then, attempt)


def _first_trial(
    at: FixedPoses,
    now: FixedPoses,
    errors: SharedErrors,
    calibration: Calibration,
    told: Floats,
    trace: Trace | None,
) -> tuple[_Trial, bool]:
    """Return the trial of the best association at the expected errors. Its rays come closest to the noise of the settings
    after a calibration. Also return whether it is a narrower association.

    The widest association allows for all the uncertainty that the errors give to the directions of rays. It is right if
    things are far apart. In a row of equal things, its gates are wider than the gaps, and rays of neighbours become one
    object at a wrong distance. Then a narrower association is right. After a calibration, the rays of a right association
    fit, and the rays of wrong objects still miss. So the associations are compared by how likely the rays are after a
    calibration. A narrower association has to be clearly better than the widest. The widest association that has an object
    is taken at once if it fits.

    at, now: the input as measured, and at the expected errors. told: (R,) rad, the noise of rays because of the uncertainty
    of the errors.
    """
    wide = now.associate(told)
    best: _Trial | None = None
    least, narrower = float("inf"), False
    tried: list[Ints] = []
    for share in (1.0, *_NARROWER):
        association = wide if share == 1.0 else now.associate(share * told)
        # Without an object, nothing is calibrated. An association that was tried already would leave the same misfit.
        if not association.count or any(np.array_equal(association.object, earlier) for earlier in tried):
            continue
        tried.append(association.object)
        trial = _tried(at, now, errors, calibration, association, trace)
        missed, left = trial.left()
        if best is None or left < least:
            best, narrower = trial, share < 1.0
            least = left - _CLEARLY if share == 1.0 else left
        if len(tried) == 1 and missed <= _FITS:
            break
    return best or _tried(at, now, errors, calibration, wide, trace), narrower


def _left(at: FixedPoses, association: Association, positions: Floats) -> tuple[float, float]:
    """Return two means over the rays: the squared miss in variances of the noise, and -2 ln of the probability up to a
    constant.

    Noise above the settings adds 4 ln of its factor to the miss, as in the normal distribution. If a label has more objects,
    a ray has more objects to choose from, so each choice is less likely. An object costs as in the Bayesian information
    criterion (Schwarz 1978). at: the input, with the noise of the poses. positions: (N, 3) m, NaN for an object without a
    position.
    """
    from objslam.graph.fixed_pose_triangulation import pose_noise

    of_ray = np.append(positions, np.full((1, 3), np.nan), axis=0)[association.object]  # Index -1 (no object): the last one.
    origin, direction = at.rays_seen.in_map(at.seen.map_T_camera)
    distance = np.maximum(np.linalg.norm(of_ray - origin, axis=1), 1e-9)
    usual = replace(at.seen, pose_noise=(1.0, 1.0))
    noises = [pose_noise(at.rays_seen, frames, at.settings) for frames in (at.seen, usual)]
    sigma, least = (np.hypot(angle, place / distance) for angle, place in noises)
    squared = (angles_off(origin, direction, of_ray) / sigma) ** 2 + 4 * np.log(sigma / least)
    missed = np.fmin(squared, STRAY_RAY)
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)
    choices = np.append(np.bincount(association.label)[association.label], 1)[association.object] if len(number) else 1
    cost = missed.sum() + 2 * np.log(choices).sum() + 3 * np.log(np.maximum(number, 1)).sum()
    return float(missed.mean()), float(cost / len(missed))


def _own(at: FixedPoses) -> Floats:
    """Return the standard deviations (R,), rad, of ray directions, from the noise of rays and of headings."""
    from objslam.graph.fixed_pose_triangulation import pose_noise

    return pose_noise(at.rays_seen, at.seen, at.settings)[0]


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


def _with_covariance(estimate: Estimate, found: FixedCalibration) -> Estimate:
    """Return an estimate with the covariance of the shared errors added to its objects."""
    from objslam.graph.posterior.marginals import largest_sigma

    told = found.calibration
    more = found.sensitivity @ told.covariance @ np.swapaxes(found.sensitivity, 1, 2)
    wider = estimate.with_errors((more + np.swapaxes(more, 1, 2)) / 2)
    sigma, correlated = largest_sigma(wider.covariance), np.nan_to_num(found.sensitivity @ told.root)
    return replace(wider, seen_sigma=sigma, calibration=told, correlated=correlated)


def _parameters(calibration: Calibration) -> Parameters:
    return Parameters(calibration.names, calibration.values, calibration.sigma)
