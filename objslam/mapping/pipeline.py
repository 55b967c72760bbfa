"""Run the offline mapping: turn a whole log into a map of objects."""

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.graph.least_squares.libraries import load_libraries
from objslam.mapping.chosen_poses import chosen_poses, lost_localization, with_mode_of, without_localization
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.localization import PriorMap
from objslam.mapping.progress import Progress, stage
from objslam.mapping.stages.described import mapped, not_placed
from objslam.mapping.stages.drive import Drive
from objslam.mapping.stages.measurements import checked, measured
from objslam.mapping.stages.result import in_known_map, result_of
from objslam.mapping.stages.second_solve import for_second_solve, reason_to_solve, shows_noise
from objslam.mapping.stages.solved import solved, without_refuted_findings, without_solved_errors


def run(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    progress: Progress = lambda stage, done, total: None,
    known: PriorMap | None = None,
) -> RunResult:
    """Map the objects of a log. The ledger counts dropped data, and the summary of the result repeats these counts.

    With mode `auto`, some logs are first mapped at their localised poses, and then solved once more in joint mode. A log
    without odometry needs settings that leave the noise of the localisation open, and one of the first three reasons. A log
    with odometry needs one of six reasons:

    - The localisation errs for seconds (`check_lasting_noise`).
    - Most objects are doubtful at the localised poses.
    - Many things are in the map twice (`maps_things_twice`).
    - The localisation errs by more than the settings say (`check_pose_noise`).
    - No object has a place at the localised poses.
    - The map is not good, and the odometry shows that the localisation errs for seconds (`odometry_contradicts`).

    If jumps of the localisation spoil the map, a log with odometry is mapped by its odometry alone. If a joint solve fails,
    the log is mapped at its localised poses. A user who interrupts the second solve gets the first map.

    known: the map of another day. If the drive is found in this map, the result is in the map's frame, and the map's objects
    count as priors. LogError if the log lacks the chosen poses, if its stamps have different units, or if no frame lies on
    the path. SolveError if no box gives a usable ray. ConfigError if calibration.file is wrong or does not fit the log.
    """
    before = ledger.copy()
    try:
        result, wrong, found = _run(log, settings, ledger, progress, known)
    except SolveError as error:
        chosen = chosen_poses(log, settings)
        if settings.mode != "auto" or chosen.localization is None or with_mode_of(chosen, settings).mode == "fixed":
            raise
        ledger.restore(before)
        ledger.warn(f"the poses cannot be solved: {error}")
        return _run(log, settings.model_copy(update={"mode": "fixed"}), ledger, progress, known)[0]
    if settings.mode == settings.poses.use == "auto" and log.odometry is not None and lost_localization(result):
        at_poses = ledger.copy()
        ledger.restore(before)
        by_odometry = settings.model_copy(update={"poses": settings.poses.model_copy(update={"use": "odometry"})})
        try:
            without_localization(ledger, "jumps, and the run does not know where it is right")
            return _run(log, by_odometry, ledger, progress, known)[0]
        except SolveError:
            ledger.restore(at_poses)
            return result
    if settings.mode != "auto" or not wrong:
        return result
    # Without odometry, the second solve takes the noise of the localisation from the rays.
    alone = chosen_poses(log, settings).odometry is None
    if alone and not (settings.finds_localization_noise and shows_noise(found, result)):
        return result
    at_poses = ledger.copy()
    ledger.restore(before)  # What a run drops counts once.
    ledger.warn(f"{wrong}, so the poses are solved too (--mode fixed keeps them)")
    try:
        return _run(log, settings.model_copy(update={"mode": "joint"}), ledger, _of_poses_too(progress), known, found)[0]
    except SolveError as error:  # The map at the given poses is better than none.
        ledger.restore(at_poses)
        ledger.warn(f"{wrong}, but the poses cannot be solved too: {error}")
        return result
    except KeyboardInterrupt:
        ledger.restore(at_poses)
        ledger.warn(f"{wrong}, but the solve of the poses was interrupted, so this is the map at the given poses")
        return result


def _run(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
    known: PriorMap | None,
    earlier: MapAtPoses | None = None,
) -> tuple[RunResult, str, MapAtPoses]:
    """Map the objects of a log as `run` does, in one mode. The second value says why the given poses seem to be wrong. It is
    "" if they do not. The third value is what a map at given poses tells a joint solve. earlier: the third value of an
    earlier call."""
    drive, seconds = Drive.of(log, settings, ledger), dict[str, float]()
    with stage("load", seconds, progress):
        load_libraries()  # Loading is a stage of its own, because it takes longer than a small solve.
    with stage("rays", seconds, progress):
        drive, frames, rays = measured(checked(drive, ledger, progress), ledger)
    of_solve = _doubting(progress, drive)
    with stage("solve", seconds, of_solve):
        found = solved(drive, frames, rays, earlier, ledger, of_solve)
    if found.drive.refutable:
        with stage("checks", seconds, progress):
            found = without_refuted_findings(found, progress)
    found = without_solved_errors(found, ledger)
    of, where = mapped(found, earlier, ledger, level=known is None), None
    if known is not None:
        with stage("localize", seconds, progress):
            of, where = in_known_map(of, known, ledger)
        if where.solution is None:
            of = not_placed(of, found, earlier)
    result = result_of(of, where, frames, seconds, ledger, progress)
    return result, reason_to_solve(of, result), for_second_solve(of, result)


def _doubting(progress: Progress, drive: Drive) -> Progress:
    """Return a progress function that also names the findings about the input if a test after the solve may refute these."""
    if not drive.refutable:
        return progress
    names = ", ".join(finding.name for finding in drive.diagnosis.findings)
    return lambda stage, done, total: progress(f"{stage} (tested after the solve: {names}?)", done, total)


def _of_poses_too(progress: Progress) -> Progress:
    """Return a progress function that marks each stage as one of the second solve."""
    return lambda stage, done, total: progress(f"poses too, {stage}", done, total)
