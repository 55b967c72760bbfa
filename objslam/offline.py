"""The offline driver: a whole log becomes a map of objects."""

from __future__ import annotations

import importlib.metadata
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from objslam import __version__
from objslam.association.extent import extents
from objslam.config import Settings
from objslam.errors import LogError, SolveError
from objslam.geometry import widest_angle
from objslam.keyframes import build_keyframes, correct_path
from objslam.ledger import Ledger
from objslam.rays import angles_off, build_rays
from objslam.reconstruction import has_depth, reconstruct
from objslam.results import RunResult
from objslam.rounds import Progress, Solution, solve
from objslam.types import Association, Camera, Floats, Log, MapObject, ObjectMap


def run(log: Log, settings: Settings, ledger: Ledger, progress: Progress = lambda stage, done, total: None) -> RunResult:
    """The object map of a log, with everything that a result holds.

    SolveError when no ray is left to solve; LogError when no frame lies on the path. What was dropped is in the ledger, and
    with it in the summary.
    """
    log = _chosen_poses(log, settings)
    seconds: dict[str, float] = {}
    with _stage("rays", seconds, progress):
        frames = build_keyframes(log, settings, ledger)
        rays = build_rays(log, frames, settings, ledger)
    if len(rays) == 0:
        raise SolveError(
            "no box gives a usable ray", where=log.name, hint="; ".join(ledger.lines()) or "the detections are empty"
        )
    cameras = tuple(c.camera for c in log.cameras)
    with _stage("solve", seconds, progress):
        solution = solve(frames, rays, cameras, settings, ledger, progress)
    keyframes, rays, estimate = solution.keyframes, solution.rays, solution.estimate
    objects, residual = _describe(solution, cameras, settings)
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    path = log.localization or log.odometry
    assert path is not None  # build_keyframes has refused such a log
    path_after = correct_path(path, keyframes.stamps, keyframes.map_T_base, estimate.map_T_base)
    surface, before = None, None
    if settings.reconstruction.use and has_depth(log):
        with _stage("reconstruction", seconds, progress):
            surface = reconstruct(log, path_after, settings, ledger, progress)
            if settings.reconstruction.before:
                before = reconstruct(log, path, settings, Ledger(), progress)  # what it drops has been said
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
        summary=_summary(log, settings, ledger, len(frames), solution, objects, seconds),
        settings=settings,
        cameras=cameras,
        path=path,
        path_after=path_after,
        trace=solution.trace,
        images=tuple(c.rgb for c in log.cameras),
        surface=surface,
        surface_before=before,
    )


def _chosen_poses(log: Log, settings: Settings) -> Log:
    use = settings.poses.use
    if use == "auto":
        return log
    if (log.odometry if use == "odometry" else log.localization) is None:
        raise LogError(f"the log has no {use}", where=log.name, hint="leave poses.use at auto")
    return replace(log, localization=None) if use == "odometry" else replace(log, odometry=None)


@contextmanager
def _stage(name: str, seconds: dict[str, float], progress: Progress) -> Iterator[None]:
    progress(name, 0, 0)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 4)


def _describe(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> tuple[ObjectMap, Floats]:
    """The objects with what can be said of each, counting rays not rejected; and how far off the rays are (R,), rad."""
    keyframes, rays, association, estimate = solution.keyframes, solution.rays, solution.association, solution.estimate
    map_T_camera = estimate.map_T_base @ keyframes.base_T_camera
    origins, directions = rays.in_map(map_T_camera)
    residual = np.full(len(rays), np.nan)
    held = association.object >= 0
    residual[held] = angles_off(origins[held], directions[held], estimate.positions[association.object[held]])
    sizes = extents(rays, association, estimate.positions, map_T_camera, keyframes, cameras)
    order = np.argsort(association.object, kind="stable")
    bounds = np.searchsorted(association.object[order], np.arange(association.count + 1))
    objects = []
    for j in range(association.count):
        mine = order[bounds[j] : bounds[j + 1]]
        kept = mine[estimate.weight[mine] > 0] if (estimate.weight[mine] > 0).any() else mine
        covariance = estimate.covariance[j]
        parallax = np.degrees(widest_angle(directions[kept]))
        ranged = bool(np.isfinite(rays.range[kept]).any())
        known = bool(estimate.solved[j] and np.isfinite(covariance).all())
        known = known and (ranged or parallax >= settings.triangulation.min_parallax_deg)
        if known:
            reach = np.median(np.linalg.norm(estimate.positions[j] - origins[kept], axis=1))
            known = bool(estimate.seen_sigma[j] <= settings.triangulation.max_rel_sigma * reach)
        stamps = keyframes.stamps[rays.keyframe[mine]]
        middle = kept[len(kept) // 2]
        objects.append(
            MapObject(
                id=j,
                label=rays.label_names[association.label[j]],
                position=estimate.positions[j],
                covariance=covariance if known else None,
                status="ok" if known else "unresolved",
                rays=len(kept),
                frames=len(np.unique(rays.keyframe[kept])),
                parallax_deg=round(float(parallax), 3),
                rms_deg=round(float(np.degrees(np.sqrt(np.mean(residual[kept] ** 2)))), 4),
                first_seen=float(stamps.min()),
                last_seen=float(stamps.max()),
                extent=(float(sizes[j, 0]), float(sizes[j, 1])) if np.isfinite(sizes[j]).all() else None,
                ray=None if known else (origins[middle], directions[middle]),
                labels=_label_shares(association, j, rays.label_names),
                existence=None if association.existence is None else round(float(association.existence[j]), 4),
            )
        )
    return ObjectMap(tuple(objects)), residual


def _label_shares(association: Association, j: int, names: tuple[str, ...]) -> dict[str, float] | None:
    if association.label_weights is None:
        return None
    shares = association.label_weights[j]
    return {names[i]: round(float(shares[i]), 4) for i in np.argsort(-shares, kind="stable") if shares[i] > 0}


def _summary(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    frames: int,
    solution: Solution,
    objects: ObjectMap,
    seconds: dict[str, float],
) -> dict[str, Any]:
    estimate, rays = solution.estimate, solution.rays
    unexplained = rays.label[solution.association.object < 0]
    total = np.bincount(rays.label, minlength=len(rays.label_names))
    left = np.bincount(unexplained, minlength=len(rays.label_names))
    boxes = sum(len(c.detections) for c in log.cameras if c.detections is not None)
    packages = ("gtsam", "torch", "numpy", "opencv-python-headless", "open3d")
    return {
        "log": log.name,
        "log_path": None if log.path is None else str(log.path),
        "mode": settings.mode,
        "counts": {
            "detection_frames": sum(len(c.detections.frame_stamps) for c in log.cameras if c.detections is not None),
            "frames_on_path": frames,
            "keyframes": len(solution.keyframes),
            "detections": boxes,
            "rays": len(rays),
            "rays_rejected": int((estimate.weight[solution.association.object >= 0] == 0).sum()),
            "rays_unexplained": len(unexplained),
            "objects": len(objects),
            "unresolved": len(objects) - len(objects.resolved()),
        },
        "unexplained_share": {
            name: round(float(n / of), 4) for name, n, of in zip(rays.label_names, left, total, strict=True) if n
        },
        "rounds": list(solution.rounds),
        "dropped": dict(ledger.dropped),
        "dropped_examples": {k: v for k, v in ledger.examples.items() if v},
        "cost_before": estimate.cost_before,
        "cost_after": estimate.cost_after,
        "iterations": estimate.iterations,
        "seconds": seconds,
        "versions": {
            "objslam": __version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in packages},
        },
        "warnings": list(ledger.warnings),
    }
