"""The late stages of a run: add bodies and wider covariances to the solution, describe the objects, and check the map."""

from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.mapping.bodies.box_heights import with_box_heights
from objslam.mapping.bodies.boxes_in_front import with_hidden_parts
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.bodies.visible_parts import without_visible_parts
from objslam.mapping.box_offsets import with_box_offsets
from objslam.mapping.checks.depth_axis import check_depth_axis
from objslam.mapping.checks.finding import JUMPS, Finding
from objslam.mapping.checks.misfits import find_misfits, with_misfits
from objslam.mapping.checks.residuals import check_pose_noise, check_residuals
from objslam.mapping.checks.verdict import widened
from objslam.mapping.contradicting_ranges import with_contradicting_ranges
from objslam.mapping.describe import describe
from objslam.mapping.fixed.far_sides import with_far_sides
from objslam.mapping.fixed.lasting_errors import check_lasting_noise, with_lasting_errors
from objslam.mapping.fixed.lasting_noise import LastingNoise
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.ground.heights import with_unknown_heights
from objslam.mapping.ground.level_path import has_free_tilt, levelled
from objslam.mapping.joint.path_against_localization import check_bent_path
from objslam.mapping.moves.near_sides import check_rows
from objslam.mapping.moves.phantoms import check_neighbours
from objslam.mapping.solution import with_jumps
from objslam.mapping.stages.solved import SolvedDrive


@dataclass(frozen=True)
class DescribedDrive:
    """A solved drive and the map of its objects.

    residual: (R,) rad, the angle between each ray and its object, NaN without an object. trusted: whether the checks of the
    input found positions reliable. lasting: the errors of given poses that last for seconds. It is None if the poses were
    solved, or if the map does not show such errors. late: the finding that given poses err for seconds, if any. noisy: the
    finding that they err by more than the settings say, if any.
    """

    found: SolvedDrive
    objects: ObjectMap
    residual: Floats
    trusted: bool
    lasting: LastingNoise | None
    late: Finding | None = None
    noisy: Finding | None = None


def mapped(found: SolvedDrive, earlier: MapAtPoses | None, ledger: Ledger, *, level: bool) -> DescribedDrive:
    """Return the map of a solved drive, in the frame of the drive.

    earlier: the map at the given poses, if this solve follows it. level: whether the path of a joint solve is turned until
    it is level. It is not turned while a place in an older map is sought. The ledger warns of what the checks of the map
    find.
    """
    complete, lasting = _completed(found, level=level)
    return _described(complete, lasting, earlier, ledger)


def not_placed(of: DescribedDrive, found: SolvedDrive, earlier: MapAtPoses | None) -> DescribedDrive:
    """Return the map of a drive that is in no older map. It is level, as without an older map.

    of: the map before it was level, from `mapped`. Its warnings count. found, earlier: as in `mapped`.
    """
    if not found.drive.joint or not has_free_tilt(found.solution.keyframes):
        return of
    return mapped(found, earlier, Ledger(), level=True)


def _completed(found: SolvedDrive, *, level: bool) -> tuple[SolvedDrive, LastingNoise | None]:
    """Return the drive with the bodies of its objects, and with the covariances that solves do not contain.

    level: whether the path of a joint solve is turned until it is level. The second value is `lasting` of `DescribedDrive`.
    """
    drive, solution, lasting = found.drive, found.solution, None
    cameras, settings = drive.cameras, drive.settings
    if drive.joint and level:
        solution = levelled(solution)
    if drive.diagnosis.jumps is not None:
        solution = with_jumps(solution, drive.diagnosis.jumps)
    if drive.joint:
        solution = with_unknown_heights(solution, settings)
    else:
        solution, lasting = with_lasting_errors(solution, settings, lambda known: with_bodies(known, cameras, settings))
    if solution.bodies is None:
        solution = with_bodies(solution, cameras, settings)
    solution = without_visible_parts(solution)
    if not drive.joint:  # This comes after the bodies, because edges of boxes show depths that rays do not show.
        solution = with_far_sides(solution)
    solution = with_hidden_parts(solution, cameras)
    return replace(found, solution=with_box_offsets(solution, cameras, settings)), lasting


def _described(
    found: SolvedDrive, lasting: LastingNoise | None, earlier: MapAtPoses | None, ledger: Ledger
) -> DescribedDrive:
    """Return the map of a completed drive, with the findings of the checks of the map. The ledger warns of them.

    lasting: from `_completed`. earlier: the map at the given poses, if this is a second solve, else None.
    """
    drive = found.drive
    trusted = not drive.diagnosis.spoilt
    objects, residual = describe(found.solution, drive.cameras, drive.settings, trusted=trusted)
    of = DescribedDrive(found, objects, residual, trusted, lasting)
    if drive.settings.checks.use:
        of = _with_checked_path(of, earlier, ledger) if drive.joint else _with_checked_poses(of, ledger)
    return _with_checked_rays(of, ledger)


def _with_checked_rays(of: DescribedDrive, ledger: Ledger) -> DescribedDrive:
    """Return a map whose covariances contain the errors that single rays, ranges and the findings about the input show."""
    drive, solution, objects = of.found.drive, of.found.solution, of.objects
    used, estimate = (solution.keyframes, solution.rays, solution.association), solution.estimate
    map_T_camera = estimate.map_T_base @ solution.keyframes.base_T_camera
    if drive.settings.checks.use:
        drive = drive.with_finding(check_depth_axis(objects, map_T_camera, *used), ledger)
    objects = with_misfits(objects, find_misfits(objects, *used, of.residual, estimate.weight, drive.settings))
    objects = with_contradicting_ranges(objects, map_T_camera, *used, estimate.weight)
    whole = estimate.weight if solution.hidden is None else np.where(solution.hidden, 0.0, estimate.weight)
    edges = drive.settings.rays.pixel_sigma
    objects = with_box_heights(objects, map_T_camera, *used, whole, drive.cameras, edges)
    objects = widened(objects, *used, estimate.weight, drive.diagnosis)
    return replace(of, found=replace(of.found, drive=drive), objects=objects)


def _with_checked_poses(of: DescribedDrive, ledger: Ledger) -> DescribedDrive:
    """Return a map at given poses with the findings about these poses that its residuals show."""
    drive, solution = of.found.drive, of.found.solution
    keyframes, settings = solution.keyframes, drive.settings
    explained = any(one.spoils or one.name != JUMPS for one in drive.diagnosis.findings)
    if not keyframes.localized_every or explained:
        return of
    calibrated, held = solution.estimate.calibration is not None, (keyframes, solution.rays, solution.association)
    noisy = check_pose_noise(of.objects, *held, settings, calibrated=calibrated)
    missing = noisy or check_residuals(of.objects, *held, of.residual, settings, calibrated=calibrated)
    late = None if of.lasting is None else check_lasting_noise(of.lasting, settings, drive.given)
    drive = drive.with_finding(missing or late, ledger)
    return replace(of, found=replace(of.found, drive=drive), late=late, noisy=noisy)


def _with_checked_path(of: DescribedDrive, earlier: MapAtPoses | None, ledger: Ledger) -> DescribedDrive:
    """Return a map of a joint solve with the findings about its path and its objects that it shows."""
    drive, solution, before = of.found.drive, of.found.solution, of.found.before
    told = None if earlier is None or earlier.lasting is None else (earlier.lasting.yaw, earlier.lasting.xy)
    drive = drive.with_finding(check_neighbours(solution, before, drive.settings, told), ledger)
    drive = drive.with_finding(check_bent_path(solution, before, drive.settings), ledger)
    names = tuple(camera.name for camera in drive.cameras)
    drive = drive.with_finding(check_rows(solution, names, drive.settings), ledger)
    return replace(of, found=replace(of.found, drive=drive))
