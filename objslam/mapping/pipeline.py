"""Run the offline mapping: turn a whole log into a map of objects."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.result import RunResult
from objslam.core.trajectory import correct_path
from objslam.core.types import Keyframes, Log, Trajectory
from objslam.errors import SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.boxes.robot_parts import without_robot_parts
from objslam.frontend.boxes.second_labels import without_second_labels
from objslam.frontend.keyframes import build_keyframes, with_given_stamps
from objslam.frontend.known_errors import shared_errors, take_out_expected, take_out_known
from objslam.frontend.localization.continued_localization import continued_by_odometry, share_on_continuation
from objslam.frontend.localization.odometry_clock import at_one_clock
from objslam.frontend.turning_clocks import in_order_of_clocks
from objslam.graph.least_squares.libraries import load_libraries
from objslam.mapping.alternation import solve
from objslam.mapping.bodies.boxes_in_front import with_hidden_parts
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.box_offsets import with_box_offsets
from objslam.mapping.checks.depth_axis import check_depth_axis
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import JUMPS
from objslam.mapping.checks.jumps import taken_out
from objslam.mapping.checks.misfits import find_misfits, with_misfits
from objslam.mapping.checks.residuals import check_pose_noise, check_residuals
from objslam.mapping.checks.shared_errors import at_bounds
from objslam.mapping.checks.upright import lies_on_its_side
from objslam.mapping.checks.verdict import say, widened
from objslam.mapping.chosen_poses import (
    chosen_poses,
    lost_localization,
    with_chosen_poses,
    with_mode_of,
    without_localization,
)
from objslam.mapping.contradicting_ranges import with_contradicting_ranges
from objslam.mapping.corrected import corrected
from objslam.mapping.describe import describe, make_result, summarise
from objslam.mapping.doubts.find import mostly_doubtful
from objslam.mapping.fixed.far_sides import with_far_sides
from objslam.mapping.fixed.lasting_errors import check_lasting_noise, with_lasting_errors
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.fixed.sparse_noise import with_sparse_noise
from objslam.mapping.ground.level_path import levelled
from objslam.mapping.ground.uneven_ground import with_uneven_ground
from objslam.mapping.joint.held_errors import check_turned_camera, with_held_errors
from objslam.mapping.joint.path_against_localization import check_bent_path
from objslam.mapping.localization import PriorMap, describe_in_map, localize, moved_log
from objslam.mapping.moves.near_sides import check_rows
from objslam.mapping.moves.odometry_witness import odometry_contradicts
from objslam.mapping.moves.phantoms import check_neighbours
from objslam.mapping.progress import Progress
from objslam.mapping.refuted import with_known_labels, without_refuted
from objslam.mapping.solution import seen_something, with_jumps
from objslam.mapping.uncorrected import uncorrected_residual
from objslam.mapping.views import solved_views


def run(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    progress: Progress = lambda stage, done, total: None,
    known: PriorMap | None = None,
) -> RunResult:
    """Map the objects of a log. The ledger counts dropped data, and the summary of the result repeats these counts.

    With mode `auto`, a log whose localisation errs for seconds (`check_lasting_noise`) is solved once more in joint mode, if
    it has odometry too, or if the settings leave the noise of the localisation open. So is a log with most objects doubtful
    at the localised poses. A log with odometry is solved once more, too, in three cases. Its localisation errs by more than
    the settings say (`check_pose_noise`). No object has a place at the localised poses. Or its map is not good, and the
    odometry shows that the localisation errs for seconds (`odometry_contradicts`). If jumps of the localisation spoil the
    map, a log with odometry is mapped by it alone. known: the map of another day. If the drive is found in it, the result is
    in its frame, and its objects count as priors. LogError if the log lacks the chosen poses, if its stamps have different
    units, or if no frame lies on the path. SolveError if no box gives a usable ray. ConfigError if calibration.file is wrong
    or does not fit the log.
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
    # Without odometry, the second solve takes the noise of the localisation from the rays.
    untold = settings.finds_localization_noise and (found.lasting is not None or mostly_doubtful(result))
    if settings.mode != "auto" or not wrong or (chosen_poses(log, settings).odometry is None and not untold):
        return result
    at_poses = ledger.copy()
    ledger.restore(before)  # What a run drops counts once.
    ledger.warn(f"{wrong}, so the poses are solved too (--mode fixed keeps them)")
    try:
        return _run(log, settings.model_copy(update={"mode": "joint"}), ledger, progress, known, found)[0]
    except SolveError as error:  # The map at the given poses is better than none.
        ledger.restore(at_poses)
        ledger.warn(f"{wrong}, but the poses cannot be solved too: {error}")
        return result


def _run(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
    known: PriorMap | None,
    earlier: MapAtPoses | None = None,
) -> tuple[RunResult, str, MapAtPoses]:
    """Map the objects of a log as `run` does, in one mode. Also return why given poses seem to be wrong, "" if they do not.
    The third value is what the map tells a joint solve, if it is at the given poses. earlier: this of an earlier map."""
    recorded = [c.detections for c in log.cameras if c.detections is not None]
    log, clock = at_one_clock(with_chosen_poses(log, settings, ledger), settings, ledger)
    log = without_robot_parts(log, settings, ledger)
    given = log = without_second_labels(log, settings, ledger)
    both, open_mode = log.localization is not None and log.odometry is not None, settings.mode == "auto"
    settings = with_mode_of(log, settings)
    expected = take_out_expected(log, settings)
    log = take_out_known(log, settings, ledger)
    seconds: dict[str, float] = {}
    with _stage("load", seconds, progress):
        load_libraries()  # Loading is a stage of its own, because it takes longer than a small solve.
    diagnosis = Diagnosis()
    with _stage("rays", seconds, progress):
        settings = with_uneven_ground(expected, settings, ledger, progress)
        if settings.checks.use:
            diagnosis = diagnose(expected, settings, ledger, progress)
            settings, diagnosis = with_sparse_noise(expected, settings, diagnosis, ledger, progress)
            if (settings.mode == "fixed" and not (open_mode and both)) or not diagnosis.refutable:
                say(diagnosis, ledger)  # No solve will refute the findings, so a user need not wait for one.
        if diagnosis.certain and settings.mode == "joint":
            ledger.warn("the poses are not solved, because a solve cannot correct wrong input")
            diagnosis = diagnosis.proven()  # No joint solve will test the other findings.
            settings = settings.model_copy(update={"mode": "fixed"})
        log = taken_out(diagnosis.jumps, log)
        localized = log
        if settings.mode == "joint":
            log = continued_by_odometry(log, settings)
        if open_mode and log is not localized:
            share = share_on_continuation(localized, log, settings)
            ledger.warn(
                f"the odometry continues the localisation for {100 * share:.0f} % of the boxes, so the poses are solved "
                "(--mode fixed leaves these boxes out)"
            )
        frames = build_keyframes(log, settings, ledger, localized.localization)
        if settings.mode == "fixed" and not frames.localized_every and not diagnosis.certain:
            cause = " and allow no calibration" if settings.calibration.use is True else ""
            ledger.warn(f"the poses are plain odometry{cause}, so the map drifts with them (--mode joint corrects both)")
        if sideways := lies_on_its_side(frames):
            ledger.warn(sideways)
        rays = build_rays(log, frames, settings, ledger)
        if settings.mode == "joint" and len(log.cameras) > 1 and len(rays):
            frames, rays = in_order_of_clocks(frames, rays, shared_errors(log, frames, rays, settings))
    if len(rays) == 0:
        say(diagnosis, ledger)
        raise SolveError(
            "no box gives a usable ray", where=log.name, hint="; ".join(ledger.lines()) or "the detections are empty"
        )
    cameras = tuple(c.camera for c in log.cameras)
    of_solve = _doubting(progress, diagnosis) if settings.mode == "joint" else progress
    with _stage("solve", seconds, of_solve):
        # Wrong input looks like large shared errors. Their estimation would take many rounds, and no object counts anyway.
        spoilt = diagnosis.spoilt and settings.mode == "fixed"
        errors = None if spoilt else shared_errors(log, *seen_something(frames, rays), settings)
        of_labels = settings
        if settings.mode == "joint" and diagnosis.refutable:
            of_labels = with_known_labels(diagnosis, log, rays, settings, of_solve)
        try:
            solution = solve(frames, rays, cameras, of_labels, ledger, of_solve, errors=errors, earlier=earlier)
        except SolveError:
            say(diagnosis, ledger)
            raise
        if solution.errors is not None:  # It may have more errors, and settings for them.
            errors, settings = solution.errors, solution.errors.settings
        before = shared_errors(log, frames, rays, settings) if settings.mode == "joint" else None
    if settings.mode == "joint" and diagnosis.refutable:
        with _stage("checks", seconds, progress):
            diagnosis = without_refuted(diagnosis, solution, log, settings, progress)
    if settings.mode == "joint" and settings.checks.use and errors is not None and not diagnosis.spoilt:
        diagnosis = diagnosis.with_findings(check_turned_camera(errors, solution))
    say(diagnosis, ledger)
    if errors is not None:
        if settings.mode == "joint":
            solution = with_held_errors(errors, solution, ledger)
        solution, log = corrected(solution, errors, ledger)
        cameras = tuple(c.camera for c in log.cameras)
        if settings.checks.use:
            diagnosis = diagnosis.with_findings(at_bounds(solution.estimate, errors.bounds))
            say(diagnosis, ledger)
    if settings.mode == "joint" and known is None:  # Objects of an older map say how a drive tilts.
        solution = levelled(solution)
    lasting, late, noisy = None, None, None
    if diagnosis.jumps is not None:
        solution = with_jumps(solution, diagnosis.jumps)
    if settings.mode == "fixed":
        solution, lasting = with_lasting_errors(solution, settings, lambda known: with_bodies(known, cameras, settings))
    if solution.bodies is None:
        solution = with_bodies(solution, cameras, settings)
    if settings.mode == "fixed":  # This comes after the bodies, because edges of boxes show depths that rays do not show.
        solution = with_far_sides(solution)
    solution = with_hidden_parts(solution, cameras)
    solution = with_box_offsets(solution, cameras, settings)
    keyframes, estimate = solution.keyframes, solution.estimate
    trusted = not diagnosis.spoilt
    objects, residual = describe(solution, cameras, settings, trusted=trusted)
    explained = any(one.spoils or one.name != JUMPS for one in diagnosis.findings)
    if settings.checks.use and settings.mode == "fixed" and keyframes.localized_every and not explained:
        calibrated, held = estimate.calibration is not None, (keyframes, solution.rays, solution.association)
        noisy = check_pose_noise(objects, *held, settings, calibrated=calibrated)
        missing = noisy or check_residuals(objects, *held, residual, settings, calibrated=calibrated)
        late = None if lasting is None else check_lasting_noise(lasting, settings, given)
        missing = missing or late
        diagnosis = diagnosis.with_findings([missing] if missing else [])
        say(diagnosis, ledger)
    told = None if earlier is None or earlier.lasting is None else (earlier.lasting.yaw, earlier.lasting.xy)
    if (
        settings.checks.use
        and settings.mode == "joint"
        and (near := check_neighbours(solution, before, settings, told)) is not None
    ):
        diagnosis = diagnosis.with_findings([near])
        say(diagnosis, ledger)
    if settings.checks.use and settings.mode == "joint" and (bent := check_bent_path(solution, before, settings)):
        diagnosis = diagnosis.with_findings([bent])
        say(diagnosis, ledger)
    names = tuple(camera.name for camera in cameras)
    if settings.checks.use and settings.mode == "joint" and (rows := check_rows(solution, names, settings)) is not None:
        diagnosis = diagnosis.with_findings([rows])
        say(diagnosis, ledger)
    used = keyframes, solution.rays, solution.association
    solved = estimate.map_T_base @ keyframes.base_T_camera
    if settings.checks.use and (wrong := check_depth_axis(objects, solved, *used)) is not None:
        diagnosis = diagnosis.with_findings([wrong])
        say(diagnosis, ledger)
    objects = with_misfits(objects, find_misfits(objects, *used, residual, estimate.weight, settings))
    objects = with_contradicting_ranges(objects, solved, *used, estimate.weight)
    objects = widened(objects, *used, estimate.weight, diagnosis)
    where = None
    if known is not None:
        with _stage("localize", seconds, progress):
            where = localize(solution, objects, known, errors, settings, ledger)
            if where.solution is not None and where.map_T_drive is not None:
                solution, objects, residual = describe_in_map(where, known, cameras, settings, trusted=trusted)
                log = moved_log(log, where.map_T_drive)
                keyframes, estimate = solution.keyframes, solution.estimate
    path = log.robot_path
    assert path is not None  # Without a path, build_keyframes raises LogError.
    path_after = _path_after(log, path, keyframes, estimate.map_T_base, settings)
    residual_before = None if errors is None else uncorrected_residual(errors, solution, path_after)
    surface, surface_before = None, None
    if settings.reconstruction.use and any(c.depth is not None for c in log.cameras):
        from objslam.mapping.reconstruction import reconstruct  # Few logs have depth images.

        with _stage("reconstruction", seconds, progress):
            surface = reconstruct(log, path_after, settings, ledger, progress)
            if settings.reconstruction.before:
                surface_before = reconstruct(log, path, settings, Ledger(), progress)  # The first call counted the drops.
    counts = {
        "images": sum(len(c.rgb.paths) for c in log.cameras if c.rgb is not None),
        "detection_frames": sum(len(detections.frame_stamps) for detections in recorded),
        "frames_on_path": len(frames),
        "detections": sum(len(detections) for detections in recorded),
    }
    result = make_result(
        replace(solution, keyframes=with_given_stamps(keyframes, given)),
        objects,
        residual,
        summary={
            **summarise(log.name, log.path, counts, settings, ledger, solution, objects, seconds),
            "part": dict(zip(("begin", "end"), log.part, strict=True)),
            "odometry_clock": None if clock is None else clock.to_dict(),
            "odometry_unused": open_mode and both and settings.mode == "fixed",
            "wrong_input": [finding.to_dict() for finding in diagnosis.findings],
            **({} if where is None else {"localisation": where.told}),
            **({"map_frame": "map"} if where is not None and where.solution is not None else {}),
        },
        settings=settings,
        cameras=cameras,
        path=path,
        path_after=path_after,
        images=tuple(c.rgb for c in log.cameras),
        surface=surface,
        surface_before=surface_before,
        residual_before=residual_before,
        views=with_given_stamps(solved_views(log, settings, path_after), given),
    )
    why = "the localisation errs for seconds" if late is not None else ""
    if not why and noisy is not None and log.odometry is not None:
        why = "the localisation errs by more than its settings say"
    if settings.mode == "fixed" and keyframes.localized_every and not diagnosis.findings and not objects.resolved():
        why = "no object has a place at the localised poses"
    # A joint solve may refute what boxes show.
    testable = open_mode and settings.mode == "fixed" and settings.checks.use and not diagnosis.certain
    doubtful, unclear = mostly_doubtful(result), result.summary["assessment"]["level"] != "good"
    if not why and testable and unclear and odometry_contradicts(given, settings):
        why = "the odometry shows that the localisation errs for seconds"
    why = why or ("many objects at the localised poses are doubtful" if testable and doubtful else "")
    found = solution.rays, solution.whole or solution.association
    return result, why, MapAtPoses(None if late is None else lasting, *found, trusted and not doubtful)


def _path_after(log: Log, path: Trajectory, keyframes: Keyframes, map_T_base: Floats, settings: Settings) -> Trajectory:
    """Return the path through the solved poses (K, 4, 4). In joint mode it follows the odometry between keyframes."""
    # Between two keyframes, the path follows the odometry. The localisation would bring back its jitter.
    after = correct_path(path, keyframes.stamps, keyframes.map_T_base, map_T_base)
    way = log.odometry
    if settings.mode == "fixed" or way is None or way is path:
        return after
    before, _ = interpolate(way.stamps, way.poses, np.clip(keyframes.stamps, way.stamps[0], way.stamps[-1]), float("inf"))
    smooth = correct_path(way, keyframes.stamps, before, map_T_base)
    poses, inside = interpolate(way.stamps, smooth.poses, path.stamps, settings.poses.max_gap)
    return Trajectory(path.stamps, np.where(inside[:, None, None], poses, after.poses))


def _doubting(progress: Progress, diagnosis: Diagnosis) -> Progress:
    """Return a progress function that also names the findings about the input, if the joint solve may refute them."""
    if not diagnosis.refutable:
        return progress
    names = ", ".join(finding.name for finding in diagnosis.findings)
    return lambda stage, done, total: progress(f"{stage} (wrong input? {names})", done, total)


@contextmanager
def _stage(name: str, seconds: dict[str, float], progress: Progress) -> Iterator[None]:
    progress(name, 0, 0)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 4)
