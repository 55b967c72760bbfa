"""The end of a session. Its keyframes and rays are solved once more, as in offline mapping, and become a result."""

import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory, correct_path
from objslam.core.types import Association, Log
from objslam.errors import SolveError
from objslam.frontend.known_errors import warn_of_others
from objslam.frontend.localization.odometry_clock import warn_of_two_clocks
from objslam.live.calibration.collected import Collected, collect
from objslam.live.mapper.state import MapState
from objslam.live.session.input_checks import diagnose_session, with_boxes
from objslam.mapping.alternation import solve
from objslam.mapping.bodies.boxes_in_front import with_hidden_parts
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.box_offsets import with_box_offsets
from objslam.mapping.checks.depth_axis import check_depth_axis
from objslam.mapping.checks.diagnosis import Diagnosis
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.misfits import find_misfits, with_misfits
from objslam.mapping.checks.shared_errors import at_bounds
from objslam.mapping.checks.verdict import say
from objslam.mapping.contradicting_ranges import with_contradicting_ranges
from objslam.mapping.corrected import corrected
from objslam.mapping.describe import describe, make_result, summarise
from objslam.mapping.joint.doubted_labels import doubted_names
from objslam.mapping.joint.held_errors import check_turned_camera, with_held_errors
from objslam.mapping.joint.labels import labels_tell, may_be_by_label
from objslam.mapping.localization import PriorMap, describe_in_map, localize, moved_log
from objslam.mapping.moves.near_sides import check_rows
from objslam.mapping.moves.phantoms import check_neighbours
from objslam.mapping.refuted import without_refuted
from objslam.mapping.solution import Solution, without_errors


def finish(m: MapState, name: str, journal: Path | None, known: PriorMap | None = None) -> RunResult:
    """Return the result of a session. Association and solve alternate as in the joint mode, from the session's estimate.

    If every label is one object so far, that association is solved. If many of its rays do not fit, the drive is associated
    again, as in an offline run. If there are more rays than live.reassociate, the session's association is kept.

    name: of the log. journal: its file, None without one. known: a prior map. If the whole drive is found in it, the
    result is in the frame of that map, as in an offline run. SolveError when no box could be mapped.
    """
    begin = time.perf_counter()
    settings, ledger = m.given, m.counters.ledger
    found = collect(m, name)
    errors, log = found.errors, found.log
    if not len(found.rays):
        kinds = {"camera": "cameras", "odometry or localisation": "odometry", "detections": "frames"}
        came = m.counters.accepted()
        came["odometry"] = came.get("odometry", 0) + came.get("localization", 0)
        missing = [f"no {what} arrived" for what, kind in kinds.items() if not came.get(kind)]
        hint = "; ".join(missing + ledger.lines())
        raise SolveError("no box could be mapped", where=name, hint=hint or None)
    if m.calibration is not None:
        warn_of_others(m.calibration, log, settings, ledger)
    recorded = with_boxes(found)
    diagnosis = diagnose_session(recorded, settings, ledger) if settings.checks.use else Diagnosis()
    paths = Log(name, (), odometry=m.course.driven.trajectory(), localization=m.course.localized.trajectory())
    warn_of_two_clocks(paths, settings, ledger)
    cameras = tuple(one.camera for one in log.cameras)
    try:
        if diagnosis.spoilt and log.localization is not None:
            ledger.warn("the poses are not solved, because a solve cannot correct wrong input")
            settings = settings.model_copy(update={"mode": "fixed"})
            solution = solve(found.keyframes, found.rays, cameras, settings, ledger, lambda *_: None)
        else:
            solution = _solved(found, m.by_label, cameras, settings, ledger)
    except SolveError:
        say(diagnosis, ledger)  # Wrong input is the probable reason.
        raise
    diagnosis = diagnosis.with_findings([_changed(name) for name in sorted(m.changed_cameras)])
    if diagnosis.refutable and settings.mode == "joint":
        diagnosis = without_refuted(diagnosis, solution, recorded, settings, lambda *_: None)
    findings = list(diagnosis.findings)
    if solution.errors is not None:
        errors, settings = solution.errors, solution.errors.settings  # It may have more errors, and settings for them.
        if settings.checks.use:
            findings += check_turned_camera(errors, solution)
        solution, log = corrected(with_held_errors(errors, solution, ledger), errors, ledger)
        cameras = tuple(one.camera for one in log.cameras)
        if settings.checks.use:
            findings += at_bounds(solution.estimate, errors.bounds)
    solution = with_hidden_parts(with_bodies(solution, cameras, settings), cameras)
    solution = with_box_offsets(solution, cameras, settings)
    keyframes, estimate = solution.keyframes, solution.estimate
    used = keyframes, solution.rays, solution.association
    trusted = not any(finding.spoils for finding in findings)
    objects, residual = describe(solution, cameras, settings, trusted=trusted)
    if settings.checks.use:
        near = check_neighbours(solution, found.errors, settings)
        depths = check_depth_axis(objects, estimate.map_T_base @ keyframes.base_T_camera, *used)
        rows = check_rows(solution, tuple(camera.name for camera in cameras), settings)
        findings += [finding for finding in (near, rows, depths) if finding is not None]
    say(Diagnosis(tuple(findings)), ledger)
    objects = with_misfits(objects, find_misfits(objects, *used, residual, estimate.weight, settings))
    objects = with_contradicting_ranges(objects, estimate.map_T_base @ keyframes.base_T_camera, *used, estimate.weight)
    ids = _kept_ids(found.association, found.ids, solution.association)
    objects = replace(objects, objects=tuple(replace(o, id=j) for o, j in zip(objects.objects, ids, strict=True)))
    where = None
    if known is not None:
        where = localize(solution, objects, known, errors, settings, ledger)
        if where.solution is not None and where.map_T_drive is not None:
            solution, objects, residual = describe_in_map(where, known, cameras, settings, ids, trusted=trusted)
            log = moved_log(log, where.map_T_drive)
            keyframes, estimate = solution.keyframes, solution.estimate
    accepted = m.counters.accepted()
    counts = {"detection_frames": accepted.get("frames", 0), "frames_on_path": sum(m.frames.values())}
    counts["detections"] = accepted.get("boxes", 0)
    seconds = {"finish": round(time.perf_counter() - begin, 4)}
    summary = summarise(name, journal, counts, settings, ledger, solution, objects, seconds)
    path = log.robot_path
    assert path is not None  # There is no keyframe without a path.
    return make_result(
        solution,
        objects,
        residual,
        summary={
            **summary,
            "wrong_input": [finding.to_dict() for finding in findings],
            "live": {**accepted, "rebuilds": m.graph.rebuilds},
            **({} if where is None else {"localisation": where.told}),
            **({"map_frame": "map"} if where is not None and where.solution is not None else {}),
        },
        settings=settings,
        cameras=cameras,
        path=path,
        path_after=_whole_path(log, keyframes.stamps, estimate.map_T_base),
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
    """Return the solution of a drive. by_label: whether every label is one object so far."""
    from objslam.graph.init_unknown_correspondences import InitialEstimate

    few = len(found.rays) <= settings.live.reassociate
    if by_label or not few:
        own = Ledger()  # Its entries count only if this solution is returned.
        solution = _solve_joint(found, settings, own)
        if not (by_label and few and _may_have_several(solution, settings)):
            ledger.add(own)
            sure = few or not by_label or settings.association.method == "by_label"
            return solution if sure else replace(solution, doubted=doubted_names(solution))
    # A session doubts all names if one label is of a thing that moves. The whole drive shows which labels are names.
    names = by_label or (few and may_be_by_label(settings, found.rays))
    start = None if names else InitialEstimate(found.map_T_camera, found.association, found.positions)
    return solve(found.keyframes, found.rays, cameras, settings, ledger, lambda *_: None, start, found.errors)


def _may_have_several(solution: Solution, settings: Settings) -> bool:
    """Return whether a label may have several objects, which no frame showed together. solution: the solution with one
    object for each label."""
    if settings.association.method == "by_label":
        return False
    if not labels_tell(solution.association, solution.estimate):
        return True
    return bool(doubted_names(solution))


def _whole_path(log: Log, stamps: Floats, map_T_base: Floats) -> Trajectory:
    """Return the recorded path at its full rate, corrected by keyframes at `stamps` (K,) with map_T_base (K, 4, 4).

    Between keyframes, the path follows the odometry, if there is one, because the localisation jitters.
    """
    way = log.odometry or log.localization
    assert way is not None  # There is no keyframe without a path.
    before, _ = interpolate(way.stamps, way.poses, np.clip(stamps, way.stamps[0], way.stamps[-1]), np.inf)
    return correct_path(way, stamps, before, map_T_base)


def _kept_ids(before: Association, ids: Ints, now: Association) -> list[int]:
    """Return an id for each object of `now`, so that an object has the same id in the snapshots and in the result.

    The objects are paired one to one so that the pairs share the most rays. An object without a partner gets a new id.
    before: the association of the same rays in the session. ids: (N,) the ids of its objects.
    """
    held = (before.object >= 0) & (now.object >= 0)
    cells = before.object[held] * now.count + now.object[held]
    shared = np.bincount(cells, minlength=before.count * now.count).reshape(before.count, now.count)
    pairs = zip(*linear_sum_assignment(shared, maximize=True), strict=True)
    kept = {int(j): int(ids[i]) for i, j in pairs if shared[i, j] > 0}
    unused = itertools.count(int(ids.max(initial=-1)) + 1)
    return [kept[j] if j in kept else next(unused) for j in range(now.count)]


def _solve_joint(found: Collected, settings: Settings, ledger: Ledger) -> Solution:
    """Return the joint solve that starts from the session's poses. The shared errors start as in an offline run.

    With at most live.reassociate rays, with odometry and without localisation, also solve from the odometry, because the
    session may have rejected rays early and for good. Return the solve with the lower cost.
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
        """The cost with the noise of the settings, because each solve may have found another noise."""
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
