"""Find a drive in the map of another day, and bring it into the frame of that map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.bodies.body import turned
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import split_se2
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trace import Round
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log, Up
from objslam.errors import SolveError
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.up import on_its_side, up_axis
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.describe import describe
from objslam.mapping.solution import Solution

if TYPE_CHECKING:
    from objslam.association.registration.map_registration import Registration
    from objslam.graph.maps.prior_map import MappedDrive


@dataclass(frozen=True)
class PriorMap:
    """The map of another day. name: the name in messages. objects: the objects, in the frame of that map. up: the axis of
    that frame that points up."""

    name: str
    objects: ObjectMap
    up: Up = "z"

    @property
    def first_free_id(self) -> int:
        """The largest id in the map plus 1. Objects that are gone count too."""
        return max((o.id for o in (*self.objects.objects, *self.objects.gone)), default=-1) + 1


@dataclass(frozen=True)
class Localization:
    """A drive in the frame of an older map, or the reason why the drive was not found in the map.

    registration: the match of the drive's objects to the objects of the map. told: the entry `localisation` of summary.json.
    The other fields are None for a drive that was not found. solution: the drive in the frame of the map. Its objects are
    positioned by the drive's rays alone. positions, covariance: (N, 3) m and (N, 3, 3) m^2, the objects by rays and map
    together. map_T_drive: (4, 4), takes points from the frame of the drive to that of the map.
    """

    registration: Registration
    told: dict[str, Any]
    solution: Solution | None = None
    positions: Floats | None = None
    covariance: Floats | None = None
    map_T_drive: Floats | None = None


def localize(
    solution: Solution, objects: ObjectMap, known: PriorMap, errors: SharedErrors | None, settings: Settings, ledger: Ledger
) -> Localization:
    """Register a drive to an older map, and solve it once more with the matched objects as priors.

    objects: the map of the drive. known: the older map. errors: the shared errors of the drive, None if none were estimated.
    The drive stays in its own frame if the registration is refused or the solve fails. The ledger then gets a warning.
    """
    # This module imports scipy.optimize, and that import takes longer than the whole map of a small log.
    from objslam.association.registration.object_maps import placed, reason, register

    found = register(objects, known.objects)
    why = reason(found, objects, known.objects, ("the drive", "the map"))
    told: dict[str, Any] = {
        "map": known.name,
        "localised": found.accepted,
        "reason": why,
        "objects": len(found.matches),
        "log_odds": _number(found.log_odds),
        "lead": _number(found.lead),
    }
    if not found.accepted:
        why = on_its_side({"the drive": up_axis(solution.keyframes), "the map": known.up}) or why
        return _refused(found, {**told, "reason": why}, why, ledger)
    try:
        solved = _solve(
            _with_covariances(solution, objects), objects, placed(objects), known.objects, found, errors, settings
        )
    except SolveError as error:
        return _refused(found, told, error.message, ledger)
    sigma = np.sqrt(np.diagonal(solved.covariance))
    told["transform"] = {**_named(solved.map_T_drive), "matrix": solved.map_T_drive.tolist()}
    told["sigma"] = dict(zip(("x", "y", "z", "yaw_deg"), (sigma * [1, 1, 1, np.degrees(1)]).tolist(), strict=True))
    told["matches"] = [
        {"id": known.objects[k].id, "label": known.objects[k].label, "drive": i} for i, k in found.matches.tolist()
    ]
    at = solved.map_T_drive
    tags = {j: tag.turned(at[:3, :3], float(sigma[3])) for j, tag in solution.estimate.tags.items()}
    estimate = replace(solution.estimate, map_T_base=solved.map_T_base, positions=solved.seen, tags=tags)
    moved = replace(
        solution,
        keyframes=replace(solution.keyframes, map_T_base=at @ solution.keyframes.map_T_base),
        estimate=estimate,
        trace=tuple(_moved_round(one, at) for one in solution.trace),
    )
    told["line"] = _line(told)
    return Localization(found, told, moved, solved.positions, solved.object_covariance, at)


def _with_covariances(solution: Solution, objects: ObjectMap) -> Solution:
    """Return the solution with the covariances of `objects`, which checks of the map may have widened."""
    widened = objects.covariances
    covariance = np.where(np.isfinite(widened), widened, solution.estimate.covariance)
    return replace(solution, estimate=replace(solution.estimate, covariance=covariance))


def _refused(found: Registration, told: dict[str, Any], why: str, ledger: Ledger) -> Localization:
    told = {**told, "localised": False, "reason": why}
    told["line"] = _line(told)
    ledger.warn(f"{told['line']}; the result stays in the frame of the drive")
    return Localization(found, told)


def _solve(
    solution: Solution,
    objects: ObjectMap,
    there: list[int],
    known: ObjectMap,
    found: Registration,
    errors: SharedErrors | None,
    settings: Settings,
) -> MappedDrive:
    from objslam.graph.assembly import Measurements
    from objslam.graph.factors.range import share_bias
    from objslam.graph.maps.prior_map import MapObjects, solve_in_map
    from objslam.graph.multiframes import Multiframes

    ours, theirs = found.matches.T
    # The graph of the drive has the points where rays meet, and the map may have centres of bodies.
    beside = found.b_T_a[:3, :3] @ (objects.positions - at_ray_points(objects).positions)[ours][..., None]
    matched = MapObjects(ours, known.positions[theirs] - beside[..., 0], known.covariances[theirs])
    measured = None
    if settings.mode == "joint":
        estimate, images, keyframes, rays = solution.estimate, solution.keyframes, solution.keyframes, solution.rays
        if errors is not None and estimate.calibration is not None:
            # A solve needs lengths corrected for its shrinkage (`NoiseFactors`). Those of the solution are as measured.
            noise = errors.noise if estimate.noise is None else estimate.noise
            images = errors.keyframes
            keyframes, rays, settings = errors.with_noise(noise).at(estimate.calibration.values)
            rays = replace(rays, direction=solution.rays.direction)  # These may point to centres of bodies.
        rays = share_bias(rays, solution.association)
        measured = Measurements.of(keyframes, rays, settings, Multiframes.of(images))
    resolved = np.array(there, dtype=np.int64)
    return solve_in_map(solution.estimate, solution.association, resolved, matched, found.b_T_a, measured)


def describe_in_map(
    where: Localization,
    known: PriorMap,
    cameras: tuple[Camera, ...],
    settings: Settings,
    ids: list[int],
    *,
    trusted: bool = True,
) -> tuple[Solution, ObjectMap, Floats]:
    """Return the solution of a drive in the frame of the map, its objects, and the residuals (R,), rad, of its rays.

    ids: (N,) the ids of the objects in the drive. trusted: if false, all objects are unresolved.
    """
    assert where.solution is not None
    solution = with_bodies(where.solution, cameras, settings)
    objects, residual = describe(solution, cameras, settings, trusted=trusted)
    objects = replace(objects, objects=tuple(replace(o, id=j) for o, j in zip(objects.objects, ids, strict=True)))
    return solution, with_map(objects, where, known), residual


def at_ray_points(objects: ObjectMap) -> ObjectMap:
    """Return the map with each object at the point where its rays meet, instead of at the centre of its body."""
    found = (o if o.ray_point is None else replace(o, position=o.ray_point) for o in objects.objects)
    return replace(objects, objects=tuple(found))


def with_map(objects: ObjectMap, where: Localization, known: PriorMap) -> ObjectMap:
    """Return the objects of a drive with the ids of the older map, at the positions in `where`.

    objects: the objects of the drive, in the frame of the map. An object without a covariance keeps its position. An object
    that the map does not have gets the first free id of the map plus its id in the drive.
    """
    assert where.positions is not None
    assert where.covariance is not None
    ids = {int(i): known.objects[int(k)].id for i, k in where.registration.matches}
    free = known.first_free_id
    moved = []
    for j, item in enumerate(objects.objects):
        number = ids.get(j, free + item.id)
        if item.covariance is None:
            moved.append(replace(item, id=number))
            continue
        point = where.positions[j]  # The point where the object's rays meet.
        position = point if item.ray_point is None else point + item.position - item.ray_point
        ray_point = None if item.ray_point is None else point
        moved.append(replace(item, id=number, position=position, covariance=where.covariance[j], ray_point=ray_point))
    return ObjectMap(tuple(moved), known.objects.frame)


def moved_object(item: MapObject, map_T_drive: Floats) -> MapObject:
    """Return an object of a drive in the frame of the map. map_T_drive: (4, 4)."""
    turn, shift = map_T_drive[:3, :3], map_T_drive[:3, 3]
    return replace(
        item,
        position=turn @ item.position + shift,
        covariance=None if item.covariance is None else turn @ item.covariance @ turn.T,
        ray=None if item.ray is None else (turn @ item.ray[0] + shift, turn @ item.ray[1]),
        seen_from=None if item.seen_from is None else replace(item.seen_from, sides=item.seen_from.sides @ turn.T),
        body=None if item.body is None else turned(item.body, turn),
        ray_point=None if item.ray_point is None else turn @ item.ray_point + shift,
        tag=None if item.tag is None else item.tag.turned(turn, 0.0),
    )


def moved_log(log: Log, map_T_drive: Floats) -> Log:
    """Return the log with odometry and localization in the frame of the map. The ground truth stays in its own frame."""
    odometry, localization = (
        None if path is None else Trajectory(path.stamps, map_T_drive @ path.poses)
        for path in (log.odometry, log.localization)
    )
    return replace(log, odometry=odometry, localization=localization)


def _moved_round(one: Round, map_T_drive: Floats) -> Round:
    steps = tuple(
        replace(step, path=_moved(step.path, map_T_drive), positions=_moved(step.positions, map_T_drive))
        for step in one.iterations
    )
    positions = _moved(one.positions, map_T_drive)
    return replace(one, iterations=steps, map_T_base=map_T_drive @ one.map_T_base, positions=positions)


def _moved(points: Any, pose: Floats) -> Any:
    return (points @ pose[:3, :3].T + pose[:3, 3]).astype(points.dtype)


def _named(pose: Floats) -> dict[str, float]:
    x, y, z = pose[:3, 3].tolist()
    return {"x": x, "y": y, "z": z, "yaw_deg": float(np.degrees(split_se2(pose)[0][2]))}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _line(told: dict[str, Any]) -> str:
    """Return the sentence about the localisation that the terminal and the report show."""
    if not told["localised"]:
        return f"not localised in {told['map']}: {told['reason']}"
    at, sigma = told["transform"], told["sigma"]
    return (
        f"localised in {told['map']} by {told['objects']} objects, log odds {told['log_odds']:.1f}, "
        f"lead {told['lead']:.1f}: "
        f"x {at['x']:z.3f} y {at['y']:z.3f} z {at['z']:z.3f} m, yaw {at['yaw_deg']:z.2f} deg, sigma at the objects "
        f"{max(sigma['x'], sigma['y'], sigma['z']):.3f} m and {sigma['yaw_deg']:.2f} deg"
    )
