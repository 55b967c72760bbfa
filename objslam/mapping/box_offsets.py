"""Add the errors that the boxes of an object share to the covariances of a map. The centre of a box lies beside the centre
of its object. All boxes from one side have about the same offset. Many rays from one side do not average this offset out, so
they count as few rays (Kish 1965)."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.association.observations import MIN_DEPTH, extents, size_per_metre
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import evenly_spread, is_planar
from objslam.core.ground.flattening import noise_of_ground
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.graph.robust_cost import ray_information
from objslam.mapping.solution import Solution, as_centres
from objslam.triangulation.bodies.shared import SIDES, WITHIN

_SHARES = 81
"""The number of shares that `_variances` tries, from 0 to `_WIDEST` times the prior. With a larger number, the estimate is
more exact and slower."""
_WIDEST = 4.0
"""The largest share that `_variances` tries, in standard deviations of the prior of the share. A larger value allows worse
detectors."""
_LOOSE = 1.0
"""The prior standard deviation (m) of the error of a solved position, in `_variances`. With a larger value, the rays decide
more."""
ANGLES = tuple(np.radians([10.0, 20.0, 40.0, 80.0]).tolist())
"""The angles (rad) between two views of an object at which the errors of its boxes may have the correlation 1/2. The true
angle was 5 to 20 degrees for one detector and three objects of YCB-Video. It is larger for a thing that is wider on one
side, or is lit from one side. A robot that sees few sides cannot measure such a large angle. With small angles alone, its
boxes would then look exact. Larger angles make positions less sure."""
_EXPECTED = 1 / np.array(ANGLES) / (1 / np.array(ANGLES)).sum()
"""(A,) the prior probability of each angle in `ANGLES`. A larger angle is less likely, because the detector above had small
angles. The boxes of many objects together outweigh this prior."""
_POOLED = 20.0
"""The number of rays with which the scatter of an object's own rays weighs as much as the scatter of all rays. With a larger
number, the scatter of one object differs less from that of the others."""


@dataclass(frozen=True)
class Sides:
    """C sides from which one object was seen.

    turned: (C, C) rad, the angle between the views from two sides. mean: (C, A) rad, the mean angle by which the rays of a
    side miss the object. It has A axes: azimuth and elevation, or elevation alone. white: (C,) rad, the standard deviation
    of this mean if the rays err independently. shift: (C, A, 3) rad per m, the derivative of the mean by the object's
    position. offset: (C, A, 3) rad, the derivative of the mean by an offset of all boxes of the side. The offset is a share
    of the object's size. pull: (C, 3, 3) m, the derivative of the object's position by this offset.
    """

    turned: Floats
    mean: Floats
    white: Floats
    shift: Floats
    offset: Floats
    pull: Floats

    def alike(self, angle: float) -> Floats:
        """Return the correlations (C, C) between the errors of each two sides, if the correlation is 1/2 at an angle
        (rad)."""
        return np.asarray(WITHIN * 0.5 ** (self.turned / angle))

    def in_elevation(self) -> Self:
        """Return the same sides without the errors in azimuth."""
        return replace(self, mean=self.mean[:, 1:], shift=self.shift[:, 1:], offset=self.offset[:, 1:])


@dataclass(frozen=True)
class SizedRays:
    """R rays, each with the angular size of its object.

    landmark: (R,) the index of each ray's object. origin: (R, 3) m, in map. direction: (R, 3) unit vectors, in map.
    distance: (R,) m, from the camera to the object. noise: (R,) rad, the standard deviation of the direction. size: (R,)
    rad, the angular size of the object. along: (R,) 1/m, one over the standard deviation of the range. It is 0 without a
    range.
    """

    landmark: Ints
    origin: Floats
    direction: Floats
    distance: Floats
    noise: Floats
    size: Floats
    along: Floats


def with_box_offsets(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> Solution:
    """Return the solution with the errors that boxes share added to its covariances. The covariances of bodies of which a
    part is hidden get these errors too.

    The centre of each box is off by the sum of two offsets. One offset is equal from all sides, and the other differs from
    side to side. Both are a share of the object's size. `rays.box_sigma` is the prior standard deviation of this share. The
    rays give an estimate of the share if `noise.rays` is true. They also do so if `noise.rays` is auto and `rays.box_sigma`
    has its default value. In joint mode, the path must also be planar.

    A sensor that measures bearings alone shows no sizes, but its objects have sizes. For these objects, the size is
    `rays.unknown_size`, and the share is the prior one.
    """
    estimate, prior = solution.estimate, settings.rays.box_sigma
    rays = _sized_rays(solution, cameras, settings)
    if prior == 0 or not len(rays.landmark):
        return solution
    map_T_camera = estimate.map_T_base @ solution.keyframes.base_T_camera
    sizes = extents(solution.rays, solution.association, estimate.positions, map_T_camera, solution.keyframes, cameras)
    sized = np.asarray(np.isfinite(sizes).all(axis=1))
    joint = settings.mode == "joint"
    seen = sides_of(rays, estimate.positions, plain=not joint and settings.fixed.loss == "l1")
    told = settings.noise.rays
    learnt = prior == type(settings.rays)().box_sigma if told == "auto" else told
    # Solved poses move until the boxes fit. On a flat floor, a planar pose cannot move up or down, so the offsets show in
    # elevation.
    if learnt and joint:
        learnt = is_planar(solution.keyframes.map_T_base) and not any(noise_of_ground(settings))
    told_by = seen
    # The box of a large thing has its centre beside the centre of the thing. That is no error of the detector.
    if learnt and not joint and (centres := as_centres(solution)) is not solution:
        plain = settings.fixed.loss == "l1"
        told_by = sides_of(_sized_rays(centres, cameras, settings), centres.estimate.positions, plain=plain)
    shown = [one.in_elevation() if joint else one for j, one in told_by.items() if sized[j]]
    variances = _variances(shown, prior) if learnt else expected_variances(prior)
    covariance, bodies = estimate.covariance.copy(), list(solution.bodies or ())
    for j, sides in seen.items():
        unknown = np.full(2, settings.rays.unknown_size)
        extent, of_share = (sizes[j], variances) if sized[j] else (unknown, expected_variances(prior))
        offset = offset_covariance(sides, extent, of_share)
        covariance[j] += offset
        body = bodies[j] if bodies else None
        if body is not None and body.behind:  # The body's centre comes from the few visible edges.
            wider = body.covariance.copy()
            wider[:3, :3] += offset
            bodies[j] = replace(body, covariance=wider)
    solution = replace(solution, bodies=tuple(bodies)) if bodies else solution
    share = float(np.sqrt(variances.sum())) if shown else None
    return replace(solution, estimate=replace(estimate, covariance=covariance, box_offset=share))


def expected_variances(share: float) -> Floats:
    """Return the prior variances (A,) of offsets, one for each angle in `ANGLES`. They are squared shares of the object's
    size.

    share: the standard deviation of an offset, as a share of the object's size.
    """
    return np.asarray(share**2 * _EXPECTED)


def offset_covariance(sides: Sides, extent: Floats, variances: Floats) -> Floats:
    """Return the covariance (3, 3) m^2 that the offsets of boxes add to the covariance of an object.

    extent: (2,) m, width and height of the object. variances: (A,) the variances of the offsets, one for each angle in
    `ANGLES`, as squared shares of the size. Their sum is the variance of an offset.
    """
    alike = sum(variance * sides.alike(angle) for angle, variance in zip(ANGLES, variances.tolist(), strict=True))
    by_side = np.einsum("cik,cd,djk->ij", sides.pull, alike, sides.pull)
    return np.asarray((by_side + by_side.T) / 2 + variances.sum() * np.nan_to_num(extent.prod()) * np.eye(3))


def _sized_rays(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> SizedRays:
    """Return the rays of objects with a position, without rays of weight 0. An object has the size `rays.unknown_size` if
    its sensor shows no sizes.

    The rays of fiducials whose corners were used are left out, because their positions do not come from boxes.
    """
    keyframes, estimate, association = solution.keyframes, solution.estimate, solution.association
    placed = np.isfinite(estimate.covariance[:, 0, 0]) & np.isfinite(estimate.positions[:, 0])
    which = np.flatnonzero((estimate.weight > 0) & (association.object >= 0))
    placed[list(estimate.tags)] = False
    which = which[placed[association.object[which]]]
    rays, landmark = solution.rays.take(which), association.object[which]
    origin, direction = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    distance = np.maximum(np.linalg.norm(estimate.positions[landmark] - origin, axis=1), MIN_DEPTH)
    angle, place = (rays.sigma, 0.0) if settings.mode == "joint" else pose_noise(rays, keyframes, settings)
    sees_size = np.array([c.sees_size for c in cameras])[keyframes.camera[rays.keyframe]]
    shown = np.sqrt(size_per_metre(rays, keyframes, cameras).prod(axis=1))
    size = np.where(sees_size, shown, settings.rays.unknown_size / distance)
    along = np.where(np.isfinite(rays.range), 1 / rays.range_sigma, 0.0)
    return SizedRays(landmark, origin, direction, distance, np.hypot(angle, place / distance), size, along)


def sides_of(rays: SizedRays, positions: Floats, *, plain: bool = False) -> dict[int, Sides]:
    """Return the sides from which each object was seen. The key is the index of the object. An object without rays has no
    entry.

    positions: (N, 3) m, of the objects, in map. plain: whether the positions are the solution of Eq. 1. In Eq. 1, a ray has
    the inverse of its standard deviation as its weight. In all other solves, its weight is the inverse of its variance.
    """
    landmark, count = rays.landmark, len(positions)
    lattice = evenly_spread(SIDES)
    pairs = np.column_stack([landmark, (rays.direction @ lattice.T).argmax(axis=1)])
    pairs, cell = np.unique(pairs, axis=0, return_inverse=True)
    cell, owner, axes = cell.ravel(), pairs[:, 0], _azimuth_elevation(lattice[pairs[:, 1]])
    flat = np.eye(3) - rays.direction[:, :, None] * rays.direction[:, None, :]
    off = np.einsum("rij,rj->ri", flat, positions[landmark] - rays.origin) / rays.distance[:, None]
    weight = rays.noise**-2
    total = np.bincount(cell, weight)
    parts = off[..., None], flat / rays.distance[:, None, None], flat * rays.size[:, None, None]
    mean, shift, offset = (_summed(axes, cell, weight, part) / total[:, None, None] for part in parts)
    miss = np.einsum("ria,ri->ra", axes[cell], off) - mean[cell, :, 0]
    own, number = (np.bincount(landmark, values, count) for values in (weight * (miss**2).sum(axis=1), np.ones(len(cell))))
    free = 2 * (number - np.bincount(owner, minlength=count))
    scatter = (own + _POOLED * (own.sum() + 1) / (free.sum() + 1)) / (free + _POOLED)
    white = np.sqrt(scatter[owner] / total)

    across = rays.noise * rays.distance
    strength, along = (1 / across, 0 * rays.along) if plain else (across**-2, rays.along**2)
    information = ray_information(rays.direction, strength, along, landmark, count)
    held = np.linalg.eigvalsh(information)[:, 0] > 0
    inverse = np.zeros_like(information)
    inverse[held] = np.linalg.inv(information[held])
    pull, towards = np.zeros((len(owner), 3, 3)), np.zeros((len(owner), 3))
    np.add.at(pull, cell, (strength * rays.size * rays.distance)[:, None, None] * flat)
    np.add.at(towards, cell, rays.direction)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    seen = {}
    for j in np.unique(owner).tolist():
        mine = np.flatnonzero(owner == j)
        seen[j] = Sides(
            turned=np.arccos(np.clip(towards[mine] @ towards[mine].T, -1, 1)),
            mean=mean[mine, :, 0],
            white=white[mine],
            shift=shift[mine],
            offset=offset[mine],
            pull=inverse[j] @ pull[mine],
        )
    return seen


def _summed(axes: Floats, cell: Ints, weight: Floats, values: Floats) -> Floats:
    """Return the weighted sums (C, 2, D) of values (R, 3, D) of rays, along the two axes (C, 3, 2) of each side. cell: (R,)
    the side of each ray."""
    sums = np.zeros((len(axes), *values.shape[1:]))
    np.add.at(sums, cell, weight[:, None, None] * values)
    return np.einsum("cia,cid->cad", axes, sums)


def _variances(seen: list[Sides], prior: float) -> Floats:
    """Return the estimated variances (A,) of the offsets of boxes, one for each angle in `ANGLES`. They are squared shares
    of the size.

    The estimate is the mean over the posterior of the share and the angle. seen: the sides of each object. prior: the
    standard deviation of a half-normal prior of the share (Gelman 2006).
    """
    shares = np.linspace(0.0, _WIDEST * prior, _SHARES)
    likelihood = np.log(_EXPECTED)[:, None] - 0.5 * (shares / prior) ** 2
    for told, angle in zip(likelihood, ANGLES, strict=True):
        for one in seen:
            told += _likelihood(one, shares, angle)
    weight = np.exp(likelihood - likelihood.max())
    return np.asarray((weight * shares**2).sum(axis=1) / weight.sum())


def _likelihood(sides: Sides, shares: Floats, angle: float) -> Floats:
    """Return the logarithm (s,) of the likelihood of each share (s,), if errors have the correlation 1/2 at an angle (rad).

    The position has an error too, so the likelihood is the restricted one (Patterson and Thompson 1971).
    """
    axes = sides.mean.shape[1]
    white = np.repeat(sides.white, axes)
    offset, shift = ((part.reshape(-1, 3) / white[:, None]) for part in (sides.offset, sides.shift))
    size, vectors = np.linalg.eigh(np.kron(sides.alike(angle), np.ones((axes, axes))) * (offset @ offset.T))
    mean, shift = vectors.T @ (sides.mean.ravel() / white), vectors.T @ shift
    variance = 1 + shares[:, None] ** 2 * np.maximum(size, 0.0)
    matrix = np.einsum("ki,kj,sk->sij", shift, shift, 1 / variance) + np.eye(3) / _LOOSE**2
    vector = np.einsum("ki,k,sk->si", shift, mean, 1 / variance)
    explained = (vector * np.linalg.solve(matrix, vector[..., None])[..., 0]).sum(axis=1)
    squares = (mean**2 / variance + np.log(variance)).sum(axis=1)
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(matrix)[1] - explained))


def _azimuth_elevation(directions: Floats) -> Floats:
    """Return the two unit vectors (n, 3, 2) in which azimuth and elevation grow, at each direction (n, 3). Both are
    perpendicular to the direction.

    No direction may be vertical.
    """
    azimuth = np.cross([0.0, 0.0, 1.0], directions)
    azimuth /= np.linalg.norm(azimuth, axis=1, keepdims=True)
    return np.stack([azimuth, np.cross(directions, azimuth)], axis=2)
