"""Find held errors that are so large that the map shows them. A held error is one that joint mode does not estimate.

With odometry alone, the place and the focal length of a camera are held, because a path that is free to bend also fits their
usual errors. The difference of two wheels is held too. A drive whose labels are no names hardly distinguishes this
difference from the bias of a gyroscope. But a gross error bends the path so much that the objects move by many of their
sigmas. So a gross error is estimated after all. Usual errors of a focal length and of the height of a camera are not
estimated, but the sigmas contain their effect. A camera that somebody turned during the drive cannot be corrected, because
no box shows when somebody turned it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.calibration import Calibration, expected_errors, kind
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import is_planar
from objslam.core.types import Association, Keyframes
from objslam.errors import SolveError
from objslam.frontend.known_errors import USUAL_FOCAL, USUAL_PLACE, known_errors, shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.parts.moved_camera import (
    MOVED,
    SIGMAS,
    finding_of_turns,
    first_half,
    in_halves,
    one_rotation_each,
    turns,
)
from objslam.mapping.solution import Solution

if TYPE_CHECKING:
    from objslam.graph.calibration.next_step import NextStep

_SETTING = {"x": "translation", "y": "translation", "focal": "focal", "turn_per_m": "turn_per_m"}
"""The setting in `calibration` of each kind of held error that can be gross. The height of a camera never shows, because it
only lifts the map."""
_USUAL = {"translation": USUAL_PLACE, "focal": USUAL_FOCAL, "turn_per_m": 0.01}
"""The standard deviation of each held error of usual robots: of a camera's place (m), of a focal length (a share), and of a
turn per metre (rad/m). One wheel of a usual robot is up to 0.3 % larger than the other, on a base of 0.3 m. With larger
values, larger errors stay in the path."""
_BENDS = "focal"
"""The setting of the held errors whose usual size the covariances contain. In ten recorded drives with focal lengths 4 % too
long, 135 of 150 objects were inside their 95 % ellipsoids without this part, and 147 with it. The sigmas of right cameras
grow by 1 %. Errors of camera places need no such part. With cameras 0.1 m off, all 45 objects of a recorded drive were
inside."""
_HEIGHT = "translation"
"""The setting of the heights of cameras. The covariances contain their usual error. Without this part, a camera that is 4 cm
higher than the log says makes all objects of a map from planar odometry alone 4 cm too low, at sigmas of 1 to 2 cm."""
_GROSS = 3.0
"""The number of standard deviations of usual errors beyond which a held error is gross. With a smaller number, the path may
bend to fit a small error that is not there. At 1.5, an image centre that was off by 20 px became a wrong place of the
camera."""
_SUSPECT = 0.6
"""A solve estimates an error if its predicted value exceeds this share of a limit. The limit is that of a gross error
(`_GROSS`) or of a turned camera (`MOVED`). One step from a bent path predicts 65 to 90 % of an error. With a smaller share,
more solves find nothing."""
_FEWEST = 60
"""The fewest boxes in each half of a drive that show whether a camera was turned. Fewer boxes agree by chance."""


@dataclass(frozen=True)
class Solved:
    """An association, its estimate, and the keyframes of this solve."""

    association: Association
    estimate: Estimate
    keyframes: Keyframes


def with_gross_errors(errors: SharedErrors, solved: Solved) -> tuple[SharedErrors | None, Estimate]:
    """Return the shared errors with the gross held errors added, so that a solve estimates these too. Return None if none is
    gross.

    Also return the estimate. If no held error is gross, the estimate has `moved_by_held`, unless `moved_by_held` cannot be
    computed. The settings of the returned errors have the prior of the new errors. Errors whose setting is not `auto` are
    not added. Errors in calibration.file are not added either, because the log is already corrected by them. errors: the
    shared errors of the solve, as measured.
    """
    held, estimate = _held(errors), solved.estimate
    if not held or not _can_tell(errors):
        return None, estimate

    def gross(found: Calibration, least: float, sigmas: float) -> list[str]:
        far = np.abs(found.values) > np.maximum(least * found.prior, sigmas * found.sigma)
        kinds = {_SETTING.get(kind(name), "") for name, one in zip(found.names, far.tolist(), strict=True) if one}
        return [name for name in held if name in kinds]

    wider = _freed(errors, held)
    if wider.names == errors.names:  # The poses are poses of the camera, so the camera has no errors of its own.
        return None, estimate
    try:
        step = _next_step(wider, solved)
        suspect = gross(step.predicted(), _SUSPECT * _GROSS, 0.0)
    except (SolveError, np.linalg.LinAlgError):
        return None, estimate
    if suspect and (there := gross(_solved(wider, solved), _GROSS, SIGMAS)):
        return _freed(errors, there), estimate
    with suppress(SolveError, np.linalg.LinAlgError):
        estimate = replace(estimate, moved_by_held=_moved_by_held(errors, solved, step))
    return None, estimate


def with_held_errors(errors: SharedErrors, solution: Solution, ledger: Ledger) -> Solution:
    """Return the solution with covariances that contain the usual errors of the focal lengths and of the cameras' heights
    that its solve held.

    errors: the shared errors of the solve, as measured. The ledger gets a warning if the effect of a focal length cannot be
    computed.
    """
    estimate = solution.estimate
    solved = Solved(solution.association, estimate, solution.keyframes)
    moved = estimate.moved_by_held
    try:
        if moved is None:
            moved = _moved_by_held(errors, solved)
    except (SolveError, np.linalg.LinAlgError) as error:
        ledger.warn(f"the sigmas lack the usual error of a focal length, which could not be computed: {error}")
    parts = [part for part in (moved, _lifted(errors, solved)) if part is not None]
    if not parts:
        return solution
    moved = np.concatenate(parts, axis=2)
    estimate = estimate.with_errors(moved @ np.swapaxes(moved, 1, 2))
    factor = moved if estimate.correlated is None else np.concatenate([estimate.correlated, moved], axis=2)
    return replace(solution, estimate=replace(estimate, correlated=factor))


def _lifted(errors: SharedErrors, solved: Solved) -> Floats | None:
    """Return how far a usual error of the height of each of the C cameras lifts the objects, (N, 3, C) m.

    Return None if the solve held no height. A camera that gave some of the rays of an object lifts it by its share of their
    weights. Poses in the plane do not rise, so this is exact for one camera. Poses in space come from a camera or a scanner,
    and their first pose has the height of the frame.
    """
    odometry, boxes = errors.keyframes.odom_T_base, solved.association.object >= 0
    cameras = [one.camera for one in errors.log.cameras]
    mounted = np.array([not np.array_equal(one.base_T_camera, np.eye(4)) for one in cameras])
    held = not errors.keyframes.localized_every and _HEIGHT in _held(errors) and mounted.any()
    if not held or odometry is None or not is_planar(odometry):
        return None
    shape = solved.association.count, len(cameras)
    weight = np.zeros(shape)
    camera = errors.keyframes.camera[errors.rays.keyframe[boxes]]
    np.add.at(weight, (solved.association.object[boxes], camera), solved.estimate.weight[boxes])
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    lifted = np.zeros((shape[0], 3, shape[1]))
    lifted[:, 2] = _USUAL[_HEIGHT] * share * mounted
    return lifted


def _moved_by_held(errors: SharedErrors, solved: Solved, step: NextStep | None = None) -> Floats | None:
    """Return how far the usual errors of the held focal lengths may move the objects, as `Estimate.moved_by_held`. Return
    None if no focal length is held. step: a known step that also covers other errors, else None."""
    if errors.keyframes.localized_every or _BENDS not in _held(errors) or not _can_tell(errors):
        return None
    wider = _freed(errors, [_BENDS])
    held = np.array([name not in errors.names for name in wider.names])
    if not held.any():  # If the poses are poses of the camera itself, no such errors exist.
        return None
    known = None if step is None else step.only(_like(wider, solved))
    return (_next_step(wider, solved) if known is None else known).moved_by(held)


def _held(errors: SharedErrors) -> list[str]:
    """Return the settings of the errors that a solve held, because the log may hardly determine these errors."""
    of, file = errors.settings.calibration, known_errors(errors.settings)
    told = set(errors.names) if file is None else {*errors.names, *file.names}
    known = {_SETTING.get(kind(name)) for name in told}
    return [name for name in _USUAL if getattr(of, name) == "auto" and name not in known]


def _freed(errors: SharedErrors, names: list[str]) -> SharedErrors:
    """Return the errors with the held errors of some settings added, so that a solve estimates these too. names: the
    settings."""
    more = errors.settings.calibration.model_copy(update={name: _USUAL[name] for name in names})
    settings = errors.settings.model_copy(update={"calibration": more})
    other = shared_errors(errors.log, errors.keyframes, errors.rays, settings)
    assert other is not None  # It has at least the errors that the solution has.
    return replace(other, noise=errors.noise).with_paths_of(errors)


def check_turned_camera(errors: SharedErrors, solution: Solution) -> list[Finding]:
    """Return a finding for each camera whose rotation differs between the halves of a drive, as the solved map shows. This
    is for drives from odometry alone. At a localisation, lasting errors of poses look like a turn, and `check_moved_camera`
    allows for these errors."""
    if errors.keyframes.localized_every:
        return []
    stamps = errors.keyframes.stamps
    late = np.asarray(stamps > np.median(stamps))
    solved = Solved(solution.association, solution.estimate, solution.keyframes)
    boxes = (solved.estimate.weight > 0) & (solved.association.object >= 0)
    of_late = late[errors.rays.keyframe[boxes]]
    if min(of_late.sum(), (~of_late).sum()) < _FEWEST or not _can_tell(errors):
        return []
    halves = _halves(errors, late)
    try:
        suspect = turns(_next_step(halves, solved).predicted(), _SUSPECT * MOVED, 0.0)
    except (SolveError, np.linalg.LinAlgError):
        return []
    if not suspect:
        return []
    return finding_of_turns(turns(_solved(halves, solved), MOVED, SIGMAS))


def _halves(errors: SharedErrors, late: Bools) -> SharedErrors:
    """Return the shared errors of a drive in which each camera is treated as two cameras, one for each half of the drive.
    late: (K,) whether a keyframe is in the second half."""
    keyframes = replace(errors.keyframes, camera=errors.keyframes.camera + len(errors.log.cameras) * late)
    log = replace(errors.log, cameras=in_halves(errors.log.cameras))
    found = shared_errors(log, keyframes, errors.rays, errors.settings)
    assert found is not None  # It has at least the errors that the solution has.
    means = dict(zip(errors.names, errors.mean.tolist(), strict=True))  # A calibration file knows no second half.
    mean = np.array([means[first_half(name)] for name in found.names])
    return replace(found, mean=mean, prior=one_rotation_each(found), noise=errors.noise).with_paths_of(errors)


def _can_tell(errors: SharedErrors) -> bool:
    """Return whether the solve can show held errors. It must estimate shared errors. No ray may be to a fiducial with
    corners, because a solve treats corners as landmarks."""
    return bool(errors.names) and errors.rays.corner_sigma is None


def _next_step(errors: SharedErrors, solved: Solved) -> NextStep:
    from objslam.graph.calibration.next_step import NextStep

    return NextStep.of(_like(errors, solved), solved.association, solved.estimate, _values(errors, solved))


def _solved(errors: SharedErrors, solved: Solved) -> Calibration:
    from objslam.graph.batch_solver import solve_joint

    start = solved.estimate.map_T_base @ solved.keyframes.base_T_camera
    like, values = _like(errors, solved), _values(errors, solved)
    given = errors.keyframes, errors.rays, solved.association, errors.settings, Ledger()
    found = solve_joint(*given, start=start, errors=like, theta=values)
    return expected_errors(errors) if found.calibration is None or found.uncalibrated else found.calibration


def _like(errors: SharedErrors, solved: Solved) -> SharedErrors:
    """Return the errors with the noise that the solve found."""
    noise = solved.estimate.noise
    return errors if noise is None else errors.with_noise(noise)


def _values(errors: SharedErrors, solved: Solved) -> Floats:
    """Return the values (P,) of the errors after the solve. A held error has the mean of its prior."""
    found = solved.estimate.calibration
    known = {} if found is None else dict(zip(found.names, found.values.tolist(), strict=True))
    means = zip(errors.names, errors.mean.tolist(), strict=True)
    return np.array([known.get(first_half(name), mean) for name, mean in means])
