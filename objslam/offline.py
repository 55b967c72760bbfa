"""The offline driver: a whole log becomes a map of objects."""

from __future__ import annotations

import importlib.metadata
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam import __version__
from objslam.association.by_label import associate_by_label
from objslam.config import Settings
from objslam.errors import SolveError
from objslam.geometry import widest_angle
from objslam.keyframes import build_keyframes, correct_path
from objslam.ledger import Ledger
from objslam.rays import angles_off, build_rays
from objslam.results import RunResult
from objslam.types import Association, Floats, Keyframes, Log, MapObject, ObjectMap, Rays

if TYPE_CHECKING:
    from objslam.graph.batch import Estimate

Progress = Callable[[str, int, int], None]
"""Called with the stage's name, what is done and the total (0 when it is not known)."""


def run(log: Log, settings: Settings, ledger: Ledger, progress: Progress = lambda stage, done, total: None) -> RunResult:
    """The object map of a log, with everything that a result holds.

    SolveError when no ray is left to solve; LogError when no frame lies on the path. What was dropped is in the ledger, and
    with it in the summary.
    """
    seconds: dict[str, float] = {}
    with _stage("rays", seconds, progress):
        keyframes = build_keyframes(log, settings, ledger)
        rays = build_rays(log, keyframes, settings, ledger)
        frames = len(keyframes)
        keyframes, rays = _seen_something(keyframes, rays)
    if len(rays) == 0:
        raise SolveError(
            "no box gives a usable ray", where=log.name, hint="; ".join(ledger.lines()) or "the detections are empty"
        )
    with _stage("association", seconds, progress):
        association = associate_by_label(rays)
        ledger.drop("boxes beside a better one of the same label in the frame", int((association.object < 0).sum()))
    with _stage("solve", seconds, progress):
        from objslam.graph import batch

        if settings.mode == "fixed":
            if not keyframes.localized_every:
                ledger.warn(
                    "the poses are odometry, taken as they are: the map drifts as they do (--mode joint corrects both)"
                )
            placed = batch.triangulate_at(keyframes.map_T_camera, keyframes, rays, association, settings)
            estimate = batch.solve_fixed(keyframes, rays, association, placed, settings)
        else:
            if not keyframes.localized_every and keyframes.odom_T_base is None:
                raise SolveError("the joint mode needs odometry or localisation", where=log.name)
            estimate = batch.solve_joint(
                keyframes, rays, association, settings, ledger, lambda done, total: progress("solve", done, total)
            )
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    residual = np.full(len(rays), np.nan)
    held = association.object >= 0
    residual[held] = angles_off(origins[held], directions[held], estimate.positions[association.object[held]])
    objects = _describe(estimate, keyframes, rays, association, origins, directions, residual, settings)
    path = log.localization or log.odometry
    assert path is not None  # build_keyframes has refused such a log
    return RunResult(
        map=objects,
        keyframes=keyframes,
        map_T_base=estimate.map_T_base,
        rays=rays,
        association=association,
        origins=origins,
        directions=directions,
        residual=residual,
        weight=estimate.weight,
        summary=_summary(log, settings, ledger, frames, keyframes, rays, objects, estimate, seconds),
        settings=settings,
        cameras=tuple(c.camera for c in log.cameras),
        path=path,
        path_after=correct_path(path, keyframes.stamps, keyframes.map_T_base, estimate.map_T_base),
    )


@contextmanager
def _stage(name: str, seconds: dict[str, float], progress: Progress) -> Iterator[None]:
    progress(name, 0, 0)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 4)


def _seen_something(keyframes: Keyframes, rays: Rays) -> tuple[Keyframes, Rays]:
    """Only the keyframes that have a ray: the others would be poses that nothing but the odometry holds."""
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)
    values = {**vars(rays), "keyframe": keyframe.astype(np.int64)}
    return keyframes.take(kept), Rays(**values)


def _describe(
    estimate: Estimate,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    origins: Floats,
    directions: Floats,
    residual: Floats,
    settings: Settings,
) -> ObjectMap:
    """The objects with what can be said of each: counts are of the rays that were not rejected."""
    objects = []
    order = np.argsort(association.object, kind="stable")
    bounds = np.searchsorted(association.object[order], np.arange(association.count + 1))
    for j in range(association.count):
        mine = order[bounds[j] : bounds[j + 1]]
        kept = mine[estimate.weight[mine] > 0] if (estimate.weight[mine] > 0).any() else mine
        position, covariance = estimate.positions[j], estimate.covariance[j]
        reach = np.median(np.linalg.norm(position - origins[kept], axis=1))
        parallax = np.degrees(widest_angle(directions[kept]))
        ranged = bool(np.isfinite(rays.range[kept]).any())
        known = bool(estimate.solved[j] and np.isfinite(covariance).all())
        known = known and (ranged or parallax >= settings.triangulation.min_parallax_deg)
        known = known and float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) <= settings.triangulation.max_rel_sigma * reach
        stamps = keyframes.stamps[rays.keyframe[mine]]
        middle = kept[len(kept) // 2]
        objects.append(
            MapObject(
                id=j,
                label=rays.label_names[association.label[j]],
                position=position,
                covariance=covariance if known else None,
                status="ok" if known else "unresolved",
                rays=len(kept),
                frames=len(np.unique(rays.keyframe[kept])),
                parallax_deg=round(float(parallax), 3),
                rms_deg=round(float(np.degrees(np.sqrt(np.mean(residual[kept] ** 2)))), 4),
                first_seen=float(stamps.min()),
                last_seen=float(stamps.max()),
                ray=None if known else (origins[middle], directions[middle]),
            )
        )
    return ObjectMap(tuple(objects))


def _summary(
    log: Log,
    settings: Settings,
    ledger: Ledger,
    frames: int,
    keyframes: Keyframes,
    rays: Rays,
    objects: ObjectMap,
    estimate: Estimate,
    seconds: dict[str, float],
) -> dict[str, Any]:
    boxes = sum(len(c.detections) for c in log.cameras if c.detections is not None)
    packages = ("gtsam", "torch", "numpy", "opencv-python-headless")
    return {
        "log": log.name,
        "mode": settings.mode,
        "counts": {
            "detection_frames": sum(len(c.detections.frame_stamps) for c in log.cameras if c.detections is not None),
            "frames_on_path": frames,
            "keyframes": len(keyframes),
            "detections": boxes,
            "rays": len(rays),
            "rays_rejected": int((estimate.weight == 0).sum()),
            "objects": len(objects),
            "unresolved": len(objects) - len(objects.resolved()),
        },
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
