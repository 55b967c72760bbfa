"""Errors that the boxes of an object share. The centre of a box is off the centre of the object. From one side, all boxes
have about the same offset. Many rays from one side do not average it out, so they count as few rays (Kish 1965)."""

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
"""The number of values that `_variances` tries, from 0 to `_WIDEST` times the prior. A larger number is finer and slower."""
_WIDEST = 4.0
"""The largest share that `_variances` tries, in standard deviations of its prior. A larger value allows worse detectors."""
_LOOSE = 1.0
"""The prior standard deviation (m) of the error of a solved position, in `_variances`. With a larger value, the rays decide
more."""
ANGLES = tuple(np.radians([10.0, 20.0, 40.0, 80.0]).tolist())
"""The angles (rad) between two views of an object at which the errors of its boxes may have the correlation 1/2. A detector
had 5 to 20 degrees on three objects of YCB-Video. Boxes of a thing that is wider on one side, or is lit from there, change
more slowly. Few sides do not show such errors, and with small angles alone the boxes would look exact. Larger angles make
positions less sure."""
_EXPECTED = 1 / np.array(ANGLES) / (1 / np.array(ANGLES)).sum()
"""(A,) the prior probability of each of `ANGLES`. It falls with the angle, as the detector above says. Many objects together
outweigh it."""
_POOLED = 20.0
"""With this many rays, the scatter of an object's own rays weighs as much as the scatter of all rays. With a larger number,
objects differ less."""


@dataclass(frozen=True)
class Sides:
    """C sides from which one object was seen.

    turned: (C, C) rad, the angle between the views from two sides. mean: (C, A) rad, the mean angle by which the rays of a
    side miss the object, along A axes (azimuth and elevation). white: (C,) rad, the standard deviation of this mean if the
    rays err independently. shift: (C, A, 3) rad per m, the derivative of the mean by the object's position. offset: (C, A,
    3) rad, the derivative of the mean by an offset of all boxes of the side. The offset is a share of the object's size.
    pull: (C, 3, 3) m, the derivative of the object's position by this offset.
    """

    turned: Floats
    mean: Floats
    white: Floats
    shift: Floats
    offset: Floats
    pull: Floats

    def alike(self, angle: float) -> Floats:
        """Return the correlations (C, C) between the errors of two sides, if they are 1/2 at this angle, rad."""
        return np.asarray(WITHIN * 0.5 ** (self.turned / angle))

    def in_elevation(self) -> Self:
        """Return the same sides without the errors in azimuth."""
        return replace(self, mean=self.mean[:, 1:], shift=self.shift[:, 1:], offset=self.offset[:, 1:])


@dataclass(frozen=True)
class SizedRays:
    """R rays of boxes that show the size of their objects.

    landmark: (R,) the object of each ray. origin, direction: (R, 3) in map. distance: (R,) m to the object. noise: (R,) rad,
    the standard deviation of the direction. size: (R,) rad, the angular size of the object. along: (R,) 1/m, one over the
    standard deviation of the range, 0 without a range.
    """

    landmark: Ints
    origin: Floats
    direction: Floats
    distance: Floats
    noise: Floats
    size: Floats
    along: Floats


def with_box_offsets(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> Solution:
    """Return the solution with the errors that boxes share added to its covariances. Hidden bodies get them too.

    The centres of an object's boxes have one offset that is equal from all sides, and one for each side. Both are a share of
    the object's size. `rays.box_sigma` is the prior standard deviation of this share. The share is estimated from the rays
    if `noise.rays` is true, or if `noise.rays` is auto and `rays.box_sigma` has its default value. In joint mode, the path
    must also be planar.

    A sensor that measures bearings only shows no sizes, but its objects are not points either. They get offsets of the prior
    share of `rays.unknown_size`.
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
    # The centre of the box of a large thing lies beside its centre. That is no error of the detector.
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
        if body is not None and body.behind:  # Its centre comes from the edges that are visible, so from few of them.
            wider = body.covariance.copy()
            wider[:3, :3] += offset
            bodies[j] = replace(body, covariance=wider)
    solution = replace(solution, bodies=tuple(bodies)) if bodies else solution
    share = float(np.sqrt(variances.sum())) if shown else None
    return replace(solution, estimate=replace(estimate, covariance=covariance, box_offset=share))


def expected_variances(share: float) -> Floats:
    """Return the variances (A,) of offsets, for each of `ANGLES`, before any box is seen.

    share: the standard deviation of an offset, as a share of the size.
    """
    return np.asarray(share**2 * _EXPECTED)


def offset_covariance(sides: Sides, extent: Floats, variances: Floats) -> Floats:
    """Return the covariance (3, 3) m^2 that the offsets of boxes add to the covariance of an object.

    extent: (2,) m, width and height of the object. variances: (A,) of the offsets, as a squared share of the size, for
    each of `ANGLES`. Their sum is the variance of an offset.
    """
    alike = sum(variance * sides.alike(angle) for angle, variance in zip(ANGLES, variances.tolist(), strict=True))
    by_side = np.einsum("cik,cd,djk->ij", sides.pull, alike, sides.pull)
    return np.asarray((by_side + by_side.T) / 2 + variances.sum() * np.nan_to_num(extent.prod()) * np.eye(3))


def _sized_rays(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> SizedRays:
    """Return the rays with a weight above 0 of objects with a position. `rays.unknown_size` is the size of objects in boxes
    that do not show it.

    Fiducials whose corners were used are left out, because their positions do not come from boxes.
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
    """Return the sides from which each object was seen, by the index of the object. An object without rays has no entry.

    positions: (N, 3) m. plain: whether the positions are the solution of Eq. 1. In Eq. 1, a ray has the inverse of its
    standard deviation as its weight. In all other solves, its weight is the inverse of its variance.
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
    """Return the weighted sums (C, 2, D) of values (R, 3, D) along the two axes (C, 3, 2) of each side. cell: (R,) the
    side."""
    sums = np.zeros((len(axes), *values.shape[1:]))
    np.add.at(sums, cell, weight[:, None, None] * values)
    return np.einsum("cia,cid->cad", axes, sums)


def _variances(seen: list[Sides], prior: float) -> Floats:
    """Return how far the boxes of one side are off: the variances (A,), for each of `ANGLES`, of their share of the size.

    The mean over the posterior of the share and the angle. seen: the sides of each object. prior: the standard deviation of
    a half-normal prior of the share (Gelman 2006).
    """
    shares = np.linspace(0.0, _WIDEST * prior, _SHARES)
    likelihood = np.log(_EXPECTED)[:, None] - 0.5 * (shares / prior) ** 2
    for told, angle in zip(likelihood, ANGLES, strict=True):
        for one in seen:
            told += _likelihood(one, shares, angle)
    weight = np.exp(likelihood - likelihood.max())
    return np.asarray((weight * shares**2).sum(axis=1) / weight.sum())


def _likelihood(sides: Sides, shares: Floats, angle: float) -> Floats:
    """Return the logarithm (s,) of the likelihood of shares (s,), if errors have the correlation 1/2 at an angle, rad.

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
    """Return the unit vectors (n, 3, 2) of growing azimuth and elevation, both perpendicular to the direction (n, 3).

    No direction may be vertical.
    """
    azimuth = np.cross([0.0, 0.0, 1.0], directions)
    azimuth /= np.linalg.norm(azimuth, axis=1, keepdims=True)
    return np.stack([azimuth, np.cross(directions, azimuth)], axis=2)
