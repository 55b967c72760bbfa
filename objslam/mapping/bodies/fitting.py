"""Give the objects of a solution bodies: upright shapes that fit the edges of their boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH, extents, size_per_metre
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import SHAPES, UNKNOWN_YAW, Body, PlacedBody
from objslam.core.camera import Camera
from objslam.core.geometry import angles_off
from objslam.core.statistics import grouped_median, widening
from objslam.frontend.surface_ranges import centre_factors, half_widths_of_rays
from objslam.frontend.up import up_axis
from objslam.graph.robust_cost import ray_information
from objslam.mapping.bodies.box_views import BoxViews
from objslam.mapping.bodies.boxes_in_front import edges_behind_boxes
from objslam.mapping.bodies.cut_boxes import cut_edges_of
from objslam.mapping.bodies.surfaces import range_shift
from objslam.mapping.solution import CentreShift, Solution
from objslam.triangulation.bodies.hidden_flanks import hidden_flanks
from objslam.triangulation.bodies.prior import apparent_half_axes
from objslam.triangulation.bodies.solve import Bodies, solve_bodies

FEWEST = 5
"""The fewest boxes of an object that gets a body. With a larger number, more objects stay points."""
_CLEAR = 1.0
"""An object gets the centre of its body as its position if the angle between this centre and the centre of the box is above
this limit. The unit is the standard deviation of the boxes' shared error. The angle is 4 for a cabinet from close by. It is
below 0.6 for things on a table that a noisy detector sees. With a larger value, more objects stay where their rays meet."""
_HIDDEN = 0.1
"""An object gets the centre of its body as its position if more than this share of its boxes are partly hidden. The rays of
partly hidden boxes miss the object, all to one side. With a larger share, more objects stay where their rays meet."""
_UNLIKE = 0.02
"""The least error of a body's centre that repeats from all sides, as a share of half the size of the body. No thing has
exactly the shape of its body. The centres of simulated pots, cones, seats, monitors and people were off by 1 to 4 % of half
the height (tools/bench_shapes.py). A larger share makes all centres less sure."""


def with_bodies(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> Solution:
    """Return a solution with a body for each object whose boxes show one. The points and their covariances do not change.

    The covariance of a centre contains the noise of the boxes, and the errors that the boxes share. One shared error is that
    a thing has not exactly the shape of its body. The covariance of the point may be larger than the noise of its rays
    explains, because solved poses have noise, or because errors of given poses last. This excess is added to the covariance
    of the centre.
    """
    if not settings.bodies.use or up_axis(solution.keyframes) != "z":  # Bodies stand upright along z.
        return solution
    views = _views(solution, cameras, settings)
    if not len(views.ray):
        return replace(solution, hidden=views.hidden)
    boxes = views.boxes
    prior = settings.rays.box_sigma
    told = settings.noise.rays
    learn = prior == type(settings.rays)().box_sigma if told == "auto" else told
    names = tuple(solution.rays.label_names[solution.association.label[j]] for j in views.objects)
    found = solve_bodies(
        boxes.edges,
        boxes.points,
        boxes.half,
        names,
        side=boxes.side,
        share=2 * prior,
        learn=learn,
        sizes=settings.bodies.sizes,
        bent=boxes.bent,
        more=lambda bodies: cut_edges_of(bodies, boxes, views.objects, solution),
    )
    # A box that the image's edge cuts off is here only if the settings or the detector say that it is whole.
    at_border = views.border.reshape(-1, 2, 2).sum(axis=1)
    found = replace(found, hidden=np.maximum(found.hidden - at_border, 0))
    clear, behind = _shifts_clearly(found, views), _behind_things(found, views)
    # A point has no flanks, and a body of a known size hides nothing.
    unsized = (found.shape > 0) & np.array([name not in settings.bodies.sizes for name in names])
    flanks = unsized[:, None, None] * hidden_flanks(boxes.edges(), found.axes)
    clear |= flanks.any(axis=(1, 2))  # Covariances of points by rays do not contain what the flanks may hide.
    bodies: list[PlacedBody | None] = [None] * solution.association.count
    extra = _beyond_rays(solution, settings, views)
    for at, j in enumerate(views.objects.tolist()):
        if found.shape[at]:
            body = _body(found, at, extra[at], flanks[at], clear=bool(clear[at] or behind[at]))
            bodies[j] = replace(body, behind=bool(behind[at]))
    to_centre = CentreShift(np.zeros((len(solution.rays), 3)), np.zeros(len(solution.rays)))
    to_centre.direction[views.ray] = np.einsum("bji,bj->bi", boxes.poses[:, :3, :3], found.to_centre)
    to_centre.sigma[views.ray] = _noise_of_hidden(found, boxes)
    hidden = views.hidden.copy()
    hidden[views.ray] |= found.hidden.any(axis=1)
    calibration = solution.estimate.calibration
    common = 0.0 if calibration is not None and "surface" in calibration.names else settings.calibration.surface
    ranges = range_shift(found, boxes, views.ray, len(solution.rays), settings, common)
    to_centre = replace(to_centre, ranges=ranges)
    return replace(solution, bodies=tuple(bodies), to_centre=to_centre, hidden=hidden)


@dataclass(frozen=True)
class _Views:
    """The boxes of objects with a point.

    objects: (n,) the objects that may get a body. ray: (B,) the used rays. boxes: the boxes of the used rays. border: (B, 4)
    which edges are at the image's edge. hidden: (R,) whether a thing in front may hide an edge of the box of each ray. Rays
    of objects with few boxes count too.
    """

    objects: Ints
    ray: Ints
    boxes: BoxViews
    border: Bools
    hidden: Bools


def _views(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> _Views:
    keyframes, estimate, association, rays = solution.keyframes, solution.estimate, solution.association, solution.rays
    map_T_camera = estimate.map_T_base @ keyframes.base_T_camera
    sizes = extents(rays, association, estimate.positions, map_T_camera, keyframes, cameras)
    fit = (
        np.isfinite(estimate.covariance[:, 0, 0])
        & np.isfinite(estimate.positions).all(axis=1)
        & np.isfinite(sizes).all(axis=1)
    )
    fit[list(estimate.tags)] = False  # The corners of a tag tell more than its box.
    sees_size = np.array([c.sees_size for c in cameras])[keyframes.camera[rays.keyframe]]
    box = (rays.box[:, 2:] > rays.box[:, :2]).all(axis=1)
    ray = np.flatnonzero((association.object >= 0) & sees_size & box)
    ray = ray[fit[association.object[ray]]]
    origin, direction = rays.take(ray).in_map(map_T_camera)
    points = estimate.positions[association.object[ray]]
    # A point that its rays do not determine may lie at the camera. Such a point has no direction.
    apart = np.linalg.norm(points - origin, axis=1) > MIN_DEPTH
    # The box of a rejected ray may still show a large thing: its ray points beside the point where the other rays meet. If
    # this point is not even near the box, the box shows another thing.
    reach = np.linalg.norm(size_per_metre(rays.take(ray), keyframes, cameras), axis=1) / 2
    near = np.tan(np.minimum(angles_off(origin, direction, points), np.pi / 4)) < np.minimum(reach, 1.0)
    ray = ray[apart & ((estimate.weight[ray] > 0) | near)]
    behind = np.zeros((len(rays), 4), dtype=bool)
    behind[ray] = edges_behind_boxes(solution, cameras, settings, map_T_camera, sizes.max(axis=1) / 2, ray)
    number = np.bincount(association.object[ray], minlength=association.count)
    objects = np.flatnonzero(fit & (number >= FEWEST))
    ray = ray[np.isin(association.object[ray], objects)]
    ray = ray[np.argsort(association.object[ray], kind="stable")]  # Sums over the boxes of a body are then fast.
    body, used = np.searchsorted(objects, association.object[ray]), rays.take(ray)
    points, half = estimate.positions[objects], apparent_half_axes(*sizes[objects].T)
    border = max(settings.rays.border, 0.0)
    size = np.array([c.size for c in cameras])[keyframes.camera[used.keyframe]]
    at_border = np.concatenate([used.box[:, :2] <= border, used.box[:, 2:] >= size - 1 - border], axis=1)
    calibration = estimate.calibration
    errors = {} if calibration is None else dict(zip(calibration.names, calibration.values.tolist(), strict=True))
    half_width = half_widths_of_rays(used, keyframes, cameras)
    used = replace(used, range=used.range / centre_factors(used, errors, half_width, settings))
    boxes = BoxViews(keyframes, used, cameras, settings, map_T_camera, body, points, half, at_border | behind[ray])
    return _Views(objects, ray, boxes, at_border, np.asarray(behind.any(axis=1)))


def _shifts_clearly(found: Bodies, views: _Views) -> Bools:
    """Return whether the centre of each body (n,) is farther from the centres of its boxes than their shared error.

    If it is not farther, the rays through the centres of the boxes give the place at least equally well. Then the body gives
    only the size.
    """
    edges = views.boxes.edges()
    shared = found.share[0] * edges.size / 2 * edges.turn.mean(axis=1)
    ratio = np.linalg.norm(found.to_centre, axis=1) / np.maximum(shared, 1e-12)
    return np.asarray(grouped_median(ratio, views.boxes.body, len(views.objects)) > _CLEAR)


def _behind_things(found: Bodies, views: _Views) -> Bools:
    """Return whether things hide parts of many boxes of each body (n,), so that its centre is the better position."""
    body, number = views.boxes.body, len(views.objects)
    return np.asarray(np.bincount(body, found.hidden.any(axis=1), number) > _HIDDEN * np.bincount(body, minlength=number))


def _noise_of_hidden(found: Bodies, boxes: BoxViews) -> Floats:
    """Return the noise (B,), rad, that hidden edges of boxes add to the directions to the centres of bodies.

    The centre of a box is the mean of two edges. If one is hidden, the centre comes from the other edge and half the size of
    the body, with the noise of both. If both are hidden, the centre may be anywhere in the box.
    """
    edges, rays, half = boxes.edges(), boxes.rays, found.axes[:, [3, 5]]
    half = half * np.sqrt(found.covariance[:, [3, 6], [3, 6]])  # From the noise of logarithms.
    away = np.maximum(np.linalg.norm(found.axes[boxes.body, :3] - edges.origin, axis=1), MIN_DEPTH)[:, None]
    one = np.hypot(rays.sigma[:, None], half[boxes.body] / away)
    size = (rays.box[:, 2:] - rays.box[:, :2]) * edges.turn[:, :2]
    noise = np.select([found.hidden == 1, found.hidden == 2], [one, np.hypot(one, size / 2)], 0.0)
    return np.asarray(noise.max(axis=1))


def _beyond_rays(solution: Solution, settings: Settings, views: _Views) -> Floats:
    """Return the part of each point's covariance (n, 3, 3), m^2, that the noise of its rays does not explain.

    At given poses, this part is `error_covariance`: the errors that were added to the covariance. The rest of the covariance
    is no error of the body. This rest is large because the rays of a large thing miss the point. The rest also contains a
    bias of Eq. 1 along the rays, which edges of boxes do not have.
    """
    estimate, rays, keyframes = solution.estimate, solution.rays, solution.keyframes
    if settings.mode != "joint":
        added = estimate.error_covariance
        return np.zeros((len(views.objects), 3, 3)) if added is None else added[views.objects]
    use = views.ray[estimate.weight[views.ray] > 0]
    origin, direction = (part[use] for part in rays.in_map(estimate.map_T_base @ keyframes.base_T_camera))
    owner = solution.association.object[use]
    distance = np.maximum(np.linalg.norm(estimate.positions[owner] - origin, axis=1), MIN_DEPTH)
    across = 1 / (rays.sigma[use] * distance) ** 2
    residual = angles_off(origin, direction, estimate.positions[owner]) * distance * np.sqrt(across)
    wider = widening(residual, owner, solution.association.count)[views.objects]
    along = np.where(np.isfinite(rays.range[use]), 1 / rays.range_sigma[use], 0.0) ** 2
    information = ray_information(direction, across, along, owner, solution.association.count)[views.objects]
    more = estimate.covariance[views.objects] - wider[:, None, None] * np.linalg.pinv(information, hermitian=True)
    size, vectors = np.linalg.eigh((more + np.swapaxes(more, 1, 2)) / 2)
    return np.asarray(np.einsum("nij,nj,nkj->nik", vectors, np.maximum(size, 0.0), vectors))


def _body(found: Bodies, at: int, extra: Floats, flanks: Floats, *, clear: bool) -> PlacedBody:
    """Return the body with the index `at`. extra: (3, 3) m^2, added to the covariance of the centre. flanks: (6, 6) m^2, as
    returned by `hidden_flanks`. clear: whether the object gets the centre of the body as its position."""
    centre, half, yaw = found.axes[at, :3], found.axes[at, 3:6], found.axes[at, 6]
    covariance = found.covariance[at] + found.unlike[at]
    covariance[:3, :3] += repeated_error(found.share[0], half) ** 2 * np.eye(3)
    covariance[[3, 6], [3, 6]] += found.share[1] ** 2
    to_size = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # from half axes to sizes
    slope = found.slope[at].copy()
    slope[:6] *= to_size[:, None]
    covariance = slope @ covariance @ slope.T
    covariance[:6, :6] += (found.between_shapes[at] + flanks) * np.outer(to_size, to_size)
    covariance[:3, :3] += extra
    sigma = np.sqrt(np.diagonal(covariance))
    body = Body(SHAPES[found.shape[at]], 2 * half, float(yaw), sigma[3:6], min(float(sigma[6]), UNKNOWN_YAW))
    return PlacedBody(body, centre if clear else None, (covariance + covariance.T) / 2)


def repeated_error(share: float, half: Floats) -> float:
    """Return the standard deviation, m, along each axis, of the error of a body's centre that repeats from all sides.

    Such an error has two causes: a detector draws all boxes too large or to one side, or the object has another shape than
    its body. share: the part of `Bodies.share` for shifts. half: (3,) half axes, m.
    """
    return float(max(share, _UNLIKE) * half.mean())
