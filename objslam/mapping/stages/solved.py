"""The middle stages of a run: solve the map, test findings about the input with it, and take out the solved errors."""

from dataclasses import dataclass, replace

from objslam.core.diagnostics import Ledger
from objslam.core.types import Keyframes, Rays
from objslam.errors import SolveError
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.alternation import solve
from objslam.mapping.checks.shared_errors import at_bounds
from objslam.mapping.checks.verdict import say
from objslam.mapping.corrected import corrected
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.joint.held_errors import check_turned_camera, with_held_errors
from objslam.mapping.progress import Progress
from objslam.mapping.refuted import with_known_labels, without_refuted
from objslam.mapping.solution import Solution, seen_something
from objslam.mapping.stages.drive import Drive


@dataclass(frozen=True)
class SolvedDrive:
    """A drive and its solution. errors: the shared errors that were estimated, None if none were. before: in joint mode, the
    shared errors as before the solve, with all frames. It is None in fixed mode, and if there are no shared errors."""

    drive: Drive
    solution: Solution
    errors: SharedErrors | None
    before: SharedErrors | None


def solved(
    drive: Drive, frames: Keyframes, rays: Rays, earlier: MapAtPoses | None, ledger: Ledger, progress: Progress
) -> SolvedDrive:
    """Return the solution of a drive, in the mode of its settings.

    earlier: an earlier map of the same drive, at the poses of the log, or None. Raises SolveError if the solve fails.
    """
    log, settings, diagnosis = drive.log, drive.settings, drive.diagnosis
    # Wrong input looks like large shared errors. Their estimation would take many rounds, and no object counts anyway.
    spoilt = diagnosis.spoilt and not drive.joint
    errors = None if spoilt else shared_errors(log, *seen_something(frames, rays), settings)
    of_labels = settings
    if drive.refutable:
        of_labels = with_known_labels(diagnosis, log, rays, settings, progress)
    try:
        solution = solve(frames, rays, drive.cameras, of_labels, ledger, progress, errors=errors, earlier=earlier)
    except SolveError:
        say(diagnosis, ledger)
        raise
    if solution.errors is not None:  # The solve may have added held errors, and settings for them.
        errors, settings = solution.errors, solution.errors.settings
    before = shared_errors(log, frames, rays, settings) if drive.joint else None
    return SolvedDrive(replace(drive, settings=settings), solution, errors, before)


def without_refuted_findings(found: SolvedDrive, progress: Progress) -> SolvedDrive:
    """Return the drive without the findings about its boxes that the solution refutes."""
    drive = found.drive
    left = without_refuted(drive.diagnosis, found.solution, drive.log, drive.settings, progress)
    return replace(found, drive=replace(drive, diagnosis=left))


def without_solved_errors(found: SolvedDrive, ledger: Ledger) -> SolvedDrive:
    """Return the drive and its solution without the shared errors that were solved.

    The ledger warns of large errors, and of all findings so far.
    """
    drive, solution, errors = found.drive, found.solution, found.errors
    if drive.joint and drive.settings.checks.use and errors is not None and not drive.diagnosis.spoilt:
        drive = replace(drive, diagnosis=drive.diagnosis.with_findings(check_turned_camera(errors, solution)))
    say(drive.diagnosis, ledger)
    if errors is None:
        return replace(found, drive=drive)
    if drive.joint:
        solution = with_held_errors(errors, solution, ledger)
    solution, log = corrected(solution, errors, ledger)
    drive = replace(drive, log=log)
    if drive.settings.checks.use:
        drive = replace(drive, diagnosis=drive.diagnosis.with_findings(at_bounds(solution.estimate, errors.bounds)))
        say(drive.diagnosis, ledger)
    return replace(found, drive=drive, solution=solution)
