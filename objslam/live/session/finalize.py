"""The end of a session. Its keyframes and rays are solved once more, as in offline mapping, and become a result."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory, correct_path
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.frontend.boxes.ignored_labels import warn_of_missing_labels
from objslam.frontend.known_errors import warn_of_others
from objslam.frontend.localization.odometry_clock import warn_of_two_clocks
from objslam.live.calibration.collected import Collected, collect
from objslam.live.mapper.state import MapState
from objslam.live.session.input_checks import diagnose_session, with_boxes
from objslam.mapping.alternation import solve
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.verdict import say
from objslam.mapping.describe import make_result, summarise
from objslam.mapping.joint.doubted_labels import doubted_names
from objslam.mapping.joint.labels import labels_tell, may_be_by_label
from objslam.mapping.localization import Localization, PriorMap
from objslam.mapping.solution import Solution, without_errors
from objslam.mapping.stages.described import DescribedDrive, mapped, not_placed
from objslam.mapping.stages.drive import Drive
from objslam.mapping.stages.result import in_known_map, in_map
from objslam.mapping.stages.solved import SolvedDrive, without_refuted_findings, without_solved_errors


def finish(m: MapState, name: str, journal: Path | None, known: PriorMap | None = None) -> RunResult:
    """Return the result of a session. Association and solve alternate as in the joint mode, from the session's estimate.

    If every label is the name of one object so far, the association by labels is solved. If many rays do not fit this
    solution, the drive is associated again, as in an offline run. With more rays than live.reassociate, the session's
    association is kept. After the solve, the stages are the same as in an offline run (`mapping/stages`).

    name: the name of the log. journal: the file of the journal, or None without a journal. known: a prior map. If the whole
    drive is found in this map, the result is in its frame, as in an offline run. Raises SolveError if no box could be
    mapped.
    """
    begin = time.perf_counter()
    ledger, found = m.counters.ledger, collect(m, name)
    warn_of_missing_labels(m.given.rays.ignore_labels, sorted({*m.labels, *m.ignored}), ledger)
    if not len(found.rays):
        raise _nothing_mapped(m, name)
    solved = _solved_drive(found, _checked(m, found, name), m.by_label, ledger)
    if solved.drive.refutable:
        solved = without_refuted_findings(solved, _silent)
    solved = without_solved_errors(solved, ledger)
    of, where = _with_kept_ids(mapped(solved, None, ledger, level=known is None), found), None
    if known is not None:
        of, where = in_known_map(of, known, ledger)
        if where.solution is None:
            of = _with_kept_ids(not_placed(of, solved, None), found)
    return _result(m, of, where, journal, round(time.perf_counter() - begin, 4))


def _silent(stage: str, done: int, total: int) -> None:
    """Show no progress, because the session has its own display."""


def _nothing_mapped(m: MapState, name: str) -> SolveError:
    """Return the error of a session without rays. It names what did not arrive, and what was dropped."""
    kinds = {"camera": "cameras", "odometry or localisation": "odometry", "detections": "frames"}
    came = m.counters.accepted()
    came["odometry"] = came.get("odometry", 0) + came.get("localization", 0)
    missing = [f"no {what} arrived" for what, kind in kinds.items() if not came.get(kind)]
    hint = "; ".join(missing + m.counters.ledger.lines())
    return SolveError("no box could be mapped", where=name, hint=hint or None)


def _checked(m: MapState, found: Collected, name: str) -> Drive:
    """Return the drive of a session with the findings about its input. Poses of input that is certainly wrong are not
    solved."""
    settings, ledger, accepted = m.given, m.counters.ledger, m.counters.accepted()
    if m.calibration is not None:
        warn_of_others(m.calibration, found.log, settings, ledger)
    recorded = with_boxes(found)
    diagnosis = diagnose_session(recorded, settings, ledger) if settings.checks.use else Diagnosis()
    paths = Log(name, (), odometry=m.course.driven.trajectory(), localization=m.course.localized.trajectory())
    warn_of_two_clocks(paths, settings, ledger)
    if diagnosis.spoilt and found.log.localization is not None:
        ledger.warn("the poses are not solved, because a solve cannot correct wrong input")
        settings = settings.model_copy(update={"mode": "fixed"})
    diagnosis = diagnosis.with_findings([_changed(name) for name in sorted(m.changed_cameras)])
    boxes, frames = accepted.get("boxes", 0), accepted.get("frames", 0)
    return Drive(recorded, recorded, settings, diagnosis, boxes, frames, chosen=False, clock=None)


def _solved_drive(found: Collected, drive: Drive, by_label: bool, ledger: Ledger) -> SolvedDrive:
    """Return the solution of a drive. by_label: whether every label is one object so far. SolveError if the solve fails."""
    settings, errors, before = drive.settings, None, found.errors
    try:
        if drive.joint:
            solution, errors = _solved(found, by_label, drive.cameras, settings, ledger), before
        else:  # As in an offline run, the shared errors of wrong input are not estimated.
            solution = solve(found.keyframes, found.rays, drive.cameras, settings, ledger, _silent)
    except SolveError:
        say(drive.diagnosis, ledger)  # Wrong input is the probable reason.
        raise
    if solution.errors is not None:  # The solution may have more errors, and settings for them.
        errors, settings = solution.errors, solution.errors.settings
    return SolvedDrive(replace(drive, settings=settings), solution, errors, before)


def _result(m: MapState, of: DescribedDrive, where: Localization | None, journal: Path | None, seconds: float) -> RunResult:
    """Return the result of a described drive. where: its place in a prior map, or None. seconds: the time that the end took,
    s."""
    drive, solution, accepted = of.found.drive, of.found.solution, m.counters.accepted()
    log, settings = drive.log, drive.settings
    counts = {"detection_frames": drive.frames, "frames_on_path": sum(m.frames.values()), "detections": drive.detections}
    of_solve = settings, m.counters.ledger, solution, of.objects
    path = log.robot_path
    assert path is not None  # There is no keyframe without a path.
    return make_result(
        solution,
        of.objects,
        of.residual,
        summary={
            **summarise(log.name, journal, counts, *of_solve, {"finish": seconds}),
            "wrong_input": [finding.to_dict() for finding in drive.diagnosis.findings],
            "live": {**accepted, "rebuilds": m.graph.rebuilds},
            **in_map(where),
        },
        settings=settings,
        cameras=drive.cameras,
        path=path,
        path_after=_whole_path(log, solution.keyframes.stamps, solution.estimate.map_T_base),
    )


def _changed(camera: str) -> Finding:
    """Return the finding that a camera changed while the session ran."""
    return Finding(
        "changed camera",
        f"camera {camera!r} got another camera matrix, distortion or image size after its first boxes. The map reads the "
        "sizes of all its boxes with the last one, so bodies may be wrong. Give the new camera a name of its own",
        spoils=False,
    )


def _solved(found: Collected, by_label: bool, cameras: tuple[Camera, ...], settings: Settings, ledger: Ledger) -> Solution:
    """Return the solution of a drive. by_label: whether the session so far took every label for the name of one object."""
    from objslam.graph.init_unknown_correspondences import InitialEstimate

    few = len(found.rays) <= settings.live.reassociate
    if by_label or not few:
        own = Ledger()  # Its entries count only if this solution is returned.
        solution = _solve_joint(found, settings, own)
        if not (by_label and few and _may_have_several(solution, settings)):
            ledger.add(own)
            sure = few or not by_label or settings.association.method == "by_label"
            return solution if sure else replace(solution, doubted=doubted_names(solution))
    # A session doubts all names if one label belongs to a moving thing. The whole drive shows which labels are names.
    names = by_label or (few and may_be_by_label(settings, found.rays))
    start = None if names else InitialEstimate(found.map_T_camera, found.association, found.positions)
    return solve(found.keyframes, found.rays, cameras, settings, ledger, lambda *_: None, start, found.errors)


def _may_have_several(solution: Solution, settings: Settings) -> bool:
    """Return whether any label may have several objects that no frame showed together. solution: the solution with one
    object for each label."""
    if settings.association.method == "by_label":
        return False
    if not labels_tell(solution.association, solution.estimate):
        return True
    return bool(doubted_names(solution))


def _whole_path(log: Log, stamps: Floats, map_T_base: Floats) -> Trajectory:
    """Return the recorded path at its full rate, corrected by keyframes at `stamps` (K,), s, with map_T_base (K, 4, 4).

    Between keyframes, the path follows the odometry if the log has odometry, because the localisation jitters.
    """
    way = log.odometry or log.localization
    assert way is not None  # There is no keyframe without a path.
    before, _ = interpolate(way.stamps, way.poses, np.clip(stamps, way.stamps[0], way.stamps[-1]), np.inf)
    return correct_path(way, stamps, before, map_T_base)


def _with_kept_ids(of: DescribedDrive, found: Collected) -> DescribedDrive:
    """Return the map with the ids of the session, so that an object has the same id in the snapshots and in the result.

    The objects are paired one to one with the objects of the session, so that the pairs share the most rays. An object
    without a partner gets a new id.
    """
    before, now = found.association, of.found.solution.association
    held = (before.object >= 0) & (now.object >= 0)
    cells = before.object[held] * now.count + now.object[held]
    shared = np.bincount(cells, minlength=before.count * now.count).reshape(before.count, now.count)
    pairs = zip(*linear_sum_assignment(shared, maximize=True), strict=True)
    kept = {int(j): int(found.ids[i]) for i, j in pairs if shared[i, j] > 0}
    unused = itertools.count(int(found.ids.max(initial=-1)) + 1)
    ids = [kept[j] if j in kept else next(unused) for j in range(now.count)]
    numbered = tuple(replace(item, id=j) for item, j in zip(of.objects.objects, ids, strict=True))
    return replace(of, objects=replace(of.objects, objects=numbered))


def _solve_joint(found: Collected, settings: Settings, ledger: Ledger) -> Solution:
    """Return the solution of the joint solve from the session's poses. The shared errors start as in an offline run.

    A second solve starts from the odometry, because the session may have rejected rays early and for good. It needs at most
    live.reassociate rays, a drive with odometry, and no localisation. The solution with the lower cost is returned.
    """
    from objslam.graph import batch_solver
    from objslam.graph.assembly import Measurements
    from objslam.graph.outlier_rejection import misfit

    keyframes, rays, association, errors = found.keyframes, found.rays, found.association, found.errors

    def solved(into: Ledger, start: Floats | None) -> Solution:
        estimate = batch_solver.solve_joint(keyframes, rays, association, settings, into, start=start, errors=errors)
        measured = (keyframes, rays) if errors is None else without_errors(errors, estimate)
        return Solution(*measured, association, estimate, (), errors=errors)

    def cost(solution: Solution) -> float:
        """Return the cost at the noise of the settings, because each of the two solves may have found another noise."""
        estimate = solution.estimate
        measured = keyframes, rays, settings
        if errors is not None:
            measured = errors.at(errors.mean if estimate.calibration is None else estimate.calibration.values)
        map_T_camera = estimate.map_T_base @ measured[0].base_T_camera
        return misfit(map_T_camera, estimate.positions, Measurements.of(*measured), association)

    first = solved(ledger, found.map_T_camera)
    few = association.count and len(rays) <= settings.live.reassociate
    if not few or keyframes.odom_T_base is None or keyframes.localized_every:
        return first
    other_ledger = Ledger()  # Its entries count only if the second solve is returned.
    try:
        other = solved(other_ledger, None)
    except SolveError:
        return first
    if not cost(other) < cost(first):
        return first
    ledger.add(other_ledger)
    return other
