"""The end of a session. Its keyframes and rays are solved once more, as in offline mapping, and become a result."""

import time
from pathlib import Path

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.result import RunResult
from objslam.core.types import Association, Keyframes, Rays, Trajectory
from objslam.errors import SolveError
from objslam.live.mapper.state import MapState
from objslam.mapping.alternation import Solution, seen_something, solve
from objslam.mapping.describe import describe, summarise


def finish(m: MapState, name: str, path: Path | None) -> RunResult:
    """Return the result of a session. Association and solve alternate as in the joint mode, from the session's estimate.

    The session's association is kept if every label is one object, or if there are more rays than live.reassociate.
    SolveError when no box could be mapped.
    """
    from objslam.graph.init_unknown_correspondences import InitialEstimate

    begin = time.perf_counter()
    settings = m.settings.model_copy(update={"mode": "joint"})
    ledger = m.counters.ledger
    keyframes, rays, association, poses, positions = collected(m)
    if not len(rays):
        kinds = {"camera": "cameras", "odometry or localisation": "odometry", "detections": "frames"}
        came = m.counters.accepted()
        came["odometry"] = came.get("odometry", 0) + came.get("localization", 0)
        missing = [f"no {what} arrived" for what, kind in kinds.items() if not came.get(kind)]
        hint = "; ".join(missing + ledger.lines())
        raise SolveError("no box could be mapped", where=name, hint=hint or None)
    cameras = tuple(m.cameras)
    if m.by_label or len(rays) > settings.live.reassociate:
        estimate = _solve_joint(keyframes, rays, association, settings, ledger, poses)
        solution = Solution(keyframes, rays, association, estimate, ())
    else:
        start = InitialEstimate(poses, association, positions)
        solution = solve(keyframes, rays, cameras, settings, ledger, lambda stage, done, total: None, start)
    keyframes, rays, estimate = solution.keyframes, solution.rays, solution.estimate
    objects, residual = describe(solution, cameras, settings)
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    accepted = m.counters.accepted()
    counts = {"detection_frames": accepted.get("frames", 0), "frames_on_path": sum(m.frames.values())}
    counts["detections"] = accepted.get("boxes", 0)
    seconds = {"finish": round(time.perf_counter() - begin, 4)}
    summary = summarise(name, path, counts, settings, ledger, solution, objects, seconds)
    stamps, first = np.unique(keyframes.stamps, return_index=True)
    return RunResult(
        map=objects,
        keyframes=keyframes,
        map_T_base=estimate.map_T_base,
        rays=rays,
        association=solution.association,
        origins=origins,
        directions=directions,
        residual=residual,
        weight=estimate.weight,
        summary={**summary, "live": {**accepted, "rebuilds": m.graph.rebuilds}},
        settings=settings,
        cameras=cameras,
        path=Trajectory(stamps, keyframes.map_T_base[first]),
        path_after=Trajectory(stamps, estimate.map_T_base[first]),
    )


def _solve_joint(
    keyframes: Keyframes, rays: Rays, association: Association, settings: Settings, ledger: Ledger, poses: Floats
) -> Estimate:
    """Return the joint solve that starts from the session's poses (K, 4, 4).

    With few rays and without localisation, also solve from the odometry. Return the solve with the smaller residuals.
    """
    from objslam.graph import batch_solver
    from objslam.graph.assembly import Measurements
    from objslam.graph.outlier_rejection import misfit

    found = batch_solver.solve_joint(keyframes, rays, association, settings, ledger, start=poses)
    few = association.count and len(rays) <= settings.live.reassociate
    if not few or keyframes.odom_T_base is None or keyframes.localized_every:
        return found
    other_ledger = Ledger()  # Of a second solve, because the session may have rejected rays early and for good.
    try:
        other = batch_solver.solve_joint(keyframes, rays, association, settings, other_ledger)
    except SolveError:
        return found
    measured = Measurements.of(keyframes, rays, settings)
    before, after = (
        misfit(estimate.map_T_base @ keyframes.base_T_camera, estimate.positions, measured, association)
        for estimate in (found, other)
    )
    if not after < before:
        return found
    ledger.add(other_ledger)
    return other


def collected(m: MapState) -> tuple[Keyframes, Rays, Association, Floats, Floats]:
    """Return keyframes in time order, their rays, the association, camera poses (K, 4, 4) and object positions (N, 3).

    If there is a localisation, keyframes that it does not cover are left out, as in offline mapping. Tracks with enough rays
    become objects too, but the solve may leave them unresolved.
    """
    m.graph.refresh()
    k, r = m.keyframes, m.rays
    order = np.argsort(k.stamp, kind="stable")
    if k.localized.any():
        off = order[~k.localized[order]]
        if len(off):
            boxes, where = int(np.isin(r.keyframe, k.id[off]).sum()), f"stamp {k.stamp[off[0]]:.3f}"
            m.counters.drop("keyframes that the localisation does not cover", where, len(off))
            m.counters.drop("boxes that the localisation does not cover", where, boxes)
        order = order[k.localized[order]]
    number = np.full(int(k.id.max(initial=-1)) + 1, -1, dtype=np.int64)
    number[k.id[order]] = np.arange(len(order))
    owner, label, place = _owners(m)
    at = number[r.keyframe]
    rows = np.flatnonzero(at >= 0)
    rows = rows[np.argsort(at[rows], kind="stable")]
    rays = offline_rays(m, rows, at[rows])
    poses = m.graph.poses(k.id[order])
    kept = np.unique(rays.keyframe)
    keyframes, rays = seen_something(m.keyframe_arrays(order), rays)
    owners, index = np.unique(owner[rows], return_inverse=True)
    objects = owners[owners >= 0]
    association = Association(index - (len(owners) - len(objects)), label[objects])
    return keyframes, rays, association, poses[kept], place[objects]


def offline_rays(m: MapState, rows: Ints, keyframe: Ints) -> Rays:
    """Return the rays in these rows (R,) as in offline mapping. keyframe: (R,) index of each ray's keyframe there."""
    names = ("direction", "sigma", "range", "range_sigma", "label", "score", "box")
    columns = {name: getattr(m.rays, name)[rows] for name in names}
    return Rays(keyframe=keyframe, **columns, track_id=m.rays.track[rows], label_names=tuple(m.labels))


def _owners(m: MapState) -> tuple[Ints, Ints, Floats]:
    """Return the object (R,) of each ray, -1 if it has none, and the labels (N,) and positions (N, 3) of the objects."""
    landmarks, rays = m.landmarks, m.rays
    owner = rays.owner.copy()
    first = int(landmarks.id.max(initial=-1)) + 1
    enough = [track for track in m.tracks if len(track.rays) >= m.settings.live.min_rays]
    label = np.zeros(first + len(enough), dtype=np.int64)
    label[landmarks.id] = landmarks.label
    place = np.zeros((len(label), 3))
    place[landmarks.id] = landmarks.position
    for i, track in enumerate(enough, first):
        owner[np.searchsorted(rays.number, track.numbers())] = i
        label[i], place[i] = track.label, track.position
    return owner, label, place
