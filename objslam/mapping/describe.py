"""Turn a solution into a result: the map of the objects, and the summary of the run."""

import importlib.metadata
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from objslam.association.observations import extents
from objslam.config import Settings
from objslam.core.arrays import Floats, Floats32, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import angles_off, is_planar, widest_angle
from objslam.core.maps.shared_covariance import shared_covariance
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import RunResult
from objslam.core.status import reach, status_of
from objslam.core.types import Association, Rays
from objslam.frontend.up import up_axis
from objslam.mapping.bodies.hidden_feet import with_hidden_feet
from objslam.mapping.checks.assessment import assess, evidence_of
from objslam.mapping.checks.residuals import misses
from objslam.mapping.doubts.find import with_doubts
from objslam.mapping.seen_sides import seen_from
from objslam.mapping.solution import Solution


def make_result(
    solution: Solution, objects: ObjectMap, residual: Floats, summary: dict[str, Any], settings: Settings, **more: Any
) -> RunResult:
    """Return the result of a run with its doubts, and add the assessment of its quality to the summary.

    objects, residual: what `describe` returns. more: the fields of `RunResult` that the solution does not have.
    """
    keyframes, rays, estimate = solution.keyframes, solution.rays, solution.estimate
    missed = misses(objects, keyframes, rays, solution.association, residual, settings)
    judged: dict[str, Any] = {"residual_times": None if np.isnan(missed) else round(missed, 3)}
    judged["assessment"] = assess(evidence_of(summary, missed)).to_dict()
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    result = RunResult(
        map=objects,
        keyframes=keyframes,
        map_T_base=estimate.map_T_base,
        rays=rays,
        association=solution.association,
        origins=origins,
        directions=directions,
        residual=residual,
        weight=counted_weights(solution.association, estimate.weight),
        trace=solution.trace,
        calibration=estimate.calibration,
        summary={**summary, **judged},
        settings=settings,
        **more,
    )
    return with_doubts(result)


def counted_weights(association: Association, weight: Floats) -> Floats:
    """Return the weights (R,) of rays. Only a ray that misses its object has the weight 0.

    A solve also gives the weight 0 to all rays of an object that it cannot place, for example without parallax. Such rays
    miss nothing, so they have the weight 1 here.
    """
    held = association.object >= 0
    some = np.bincount(association.object[held & (weight > 0)], minlength=association.count) > 0
    outside = held & ~np.append(some, True)[association.object]
    return np.where(outside, 1.0, weight)


def describe(
    solution: Solution, cameras: tuple[Camera, ...], settings: Settings, *, trusted: bool = True
) -> tuple[ObjectMap, Floats]:
    """Return the map of the objects, and the angle (R,) in rad between each ray and its object. The angle is NaN for a ray
    without an object.

    The counts of rays and frames leave out rejected rays, unless all rays of the object are rejected. The position of an
    object with a body may be the centre of the body (`PlacedBody`). trusted: if false, all objects are unresolved.
    """
    keyframes, rays, association, estimate = solution.keyframes, solution.rays, solution.association, solution.estimate
    map_T_camera = estimate.map_T_base @ keyframes.base_T_camera
    origins, directions = rays.in_map(map_T_camera)
    residual = np.full(len(rays), np.nan)
    held = association.object >= 0
    residual[held] = angles_off(origins[held], directions[held], estimate.positions[association.object[held]])
    sizes = extents(rays, association, estimate.positions, map_T_camera, keyframes, cameras)
    sizes_of_images = np.array([camera.size for camera in cameras])[keyframes.camera[rays.keyframe]]
    order = np.argsort(association.object, kind="stable")
    bounds = np.searchsorted(association.object[order], np.arange(association.count + 1))
    objects = []
    for j in range(association.count):
        mine = order[bounds[j] : bounds[j + 1]]
        kept = mine[estimate.weight[mine] > 0] if (estimate.weight[mine] > 0).any() else mine
        placed = None if solution.bodies is None else solution.bodies[j]
        covariance = estimate.covariance[j] if placed is None or placed.centre is None else placed.covariance[:3, :3]
        position = estimate.positions[j] if placed is None or placed.centre is None else placed.centre
        parallax = widest_angle(directions[kept])
        solved = bool(estimate.solved[j] and np.isfinite(covariance).all())
        status = status_of(
            sigma=float(estimate.seen_sigma[j]) if solved and trusted else np.inf,
            reach=reach(estimate.positions[j], origins[kept]),
            rays=len(kept),
            parallax=parallax,
            ranged=bool(np.isfinite(rays.range[kept]).any()),
            limits=settings.triangulation,
        )
        known = status == "ok"
        stamps = keyframes.stamps[rays.keyframe[mine]]
        middle = kept[len(kept) // 2]
        objects.append(
            MapObject(
                id=j,
                label=rays.label_names[association.label[j]],
                position=position if known else estimate.positions[j],
                covariance=covariance if known else None,
                status=status,
                rays=len(kept),
                frames=len(np.unique(rays.keyframe[kept])),
                parallax_deg=round(float(np.degrees(parallax)), 3),
                rms_deg=round(float(np.degrees(np.sqrt(np.mean(residual[kept] ** 2)))), 4),
                first_seen=float(stamps.min()),
                last_seen=float(stamps.max()),
                extent=(float(sizes[j, 0]), float(sizes[j, 1])) if np.isfinite(sizes[j]).all() else None,
                ray=None if known else (origins[middle], directions[middle]),
                labels=_label_shares(association, j, mine, rays),
                existence=_existence(association, j),
                seen_from=seen_from(estimate.positions[j], origins[kept]) if known else None,
                body=placed.body if placed is not None and known else None,
                ray_point=None if placed is None or placed.centre is None or not known else estimate.positions[j],
                tag=estimate.tags.get(j) if known else None,
                features=_best_view(rays, kept, sizes_of_images),
            )
        )
    return ObjectMap(with_hidden_feet(tuple(objects)), shared_covariance=_shared(objects, estimate)), residual


def _best_view(rays: Rays, mine: Ints, image: Floats) -> Floats32 | None:
    """Return the appearance vector (D,) of the best view among the rays `mine`. Return None if no ray has such a vector.

    The best view is the largest box that lies inside its image, or the largest box if none does. A mean of vectors would fit
    no real view. image: (R, 2) width and height of the image of each ray, px.
    """
    if rays.feature is None or rays.feature_table is None or not (rays.feature[mine] >= 0).any():
        return None
    mine = mine[rays.feature[mine] >= 0]
    low, high = rays.box[mine, :2], rays.box[mine, 2:]
    inside = ((low > 0) & (high < image[mine] - 1)).all(axis=1)
    best = mine[np.lexsort((-(high - low).prod(axis=1), ~inside))[0]]
    return rays.feature_table.vectors[rays.feature[best]]


def _shared(objects: list[MapObject], estimate: Estimate) -> Floats | None:
    """Return the covariance (7, 7) of the error that the resolved objects share (`shared_covariance`). Return None if it is
    not known."""
    known = [j for j, o in enumerate(objects) if o.covariance is not None]
    if estimate.correlated is None or not known:
        return None
    some = ObjectMap(tuple(objects[j] for j in known))
    return shared_covariance(some.positions, some.covariances, estimate.correlated[known])


def _cut_off(rays: Rays) -> dict[str, int]:
    """Return the number of boxes of each label that the image's edge cuts off. A label without such boxes has no entry."""
    if rays.cut is None:
        return {}
    number = np.bincount(rays.cut.label, minlength=len(rays.label_names))
    return {name: int(n) for name, n in zip(rays.label_names, number, strict=True) if n}


def _label_shares(association: Association, j: int, mine: Ints, rays: Rays) -> dict[str, float] | None:
    """Return the share of each label among the boxes of an object. A second box on the same thing was dropped, but its label
    counts. mine: (n,) the object's rays."""
    if association.label_weights is None:
        return None
    shares, names = association.label_weights[j], rays.label_names
    if rays.second is not None:
        second = rays.second[mine]
        counts = len(second) * shares + np.bincount(second[second >= 0], minlength=len(names))
        shares = counts / max(counts.sum(), 1.0)
    return {names[i]: round(float(shares[i]), 4) for i in np.argsort(-shares, kind="stable") if shares[i] > 0}


def _existence(association: Association, j: int) -> float | None:
    if association.existence is None or np.isnan(association.existence[j]):
        return None
    return round(float(association.existence[j]), 4)


def summarise(
    name: str,
    path: Path | None,
    counts: dict[str, int],
    settings: Settings,
    ledger: Ledger,
    solution: Solution,
    objects: ObjectMap,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Return the content of summary.json.

    counts: the numbers of images, frames and boxes in the log. seconds: the time of each stage. The entry `map_frame` is
    `localization` if absolute poses fixed the frame of the map, else `odometry`. `planar` is true if the measured path has
    one height, roll and pitch. `up` is the axis of the map that points up, for example "z".
    """
    estimate, rays = solution.estimate, solution.rays
    weight = counted_weights(solution.association, estimate.weight)
    unexplained = rays.label[solution.association.object < 0]
    total, left = (np.bincount(labels, minlength=len(rays.label_names)) for labels in (rays.label, unexplained))
    return {
        "log": name,
        "log_path": None if path is None else str(path),
        "mode": settings.mode,
        "map_frame": "localization" if solution.keyframes.localized_every else "odometry",
        "planar": is_planar(solution.keyframes.map_T_base),
        "up": up_axis(solution.keyframes),
        "counts": {
            **counts,
            "keyframes": len(solution.keyframes),
            "rays": len(rays),
            "rays_rejected": int(((weight == 0) & (solution.association.object >= 0)).sum()),
            "rays_unexplained": len(unexplained),
            "objects": len(objects),
            "unresolved": len(objects) - len(objects.resolved()),
        },
        "unexplained_share": {
            label: round(float(n / of), 4) for label, n, of in zip(rays.label_names, left, total, strict=True) if n
        },
        "cut_off": _cut_off(rays),
        "doubted_labels": list(solution.doubted),
        "unsettled_objects": solution.unsettled,
        "unfinished_search": solution.unfinished,
        "copied_objects": solution.copied,
        "several_objects_a_label": len({one.label for one in objects}) < len(objects),
        "uncalibrated": estimate.uncalibrated,
        "rounds": list(solution.rounds),
        "calibration": None if estimate.calibration is None else estimate.calibration.to_dict(),
        "noise": None if estimate.noise is None else estimate.noise.to_dict(),
        "range_noise_by_label": {} if estimate.noise is None else estimate.noise.labels_to_dict(),
        "box_offset": None if estimate.box_offset is None else round(estimate.box_offset, 4),
        "unused_paths": list(ledger.unused),
        "dropped": dict(ledger.dropped),
        "dropped_examples": {k: v for k, v in ledger.examples.items() if v},
        "cost_before": estimate.cost_before,
        "cost_after": estimate.cost_after,
        "iterations": estimate.iterations,
        "seconds": seconds,
        "versions": dict(_versions()),
        "warnings": ledger.lines(),
    }


@cache
def _versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that can change a result. They are read once, and then
    kept."""
    found = {"python": platform.python_version()}
    for package in ("objslam", "gtsam", "torch", "numpy", "opencv-python-headless", "open3d"):
        with suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found
