"""Errors that the boxes of an object share: the centre of a box is not that of the object, and errs alike from one side.

More rays from the same side do not average such an error out, so that many of them count as few (Kish 1965).
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import extents, size_per_metre
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import evenly_spread, is_planar
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.graph.robust_cost import ray_information
from objslam.mapping.alternation import Solution

_SIDES = 103
"""The number of sides from which an object can be seen, evenly over the sphere. They are 20 degrees apart. Rays from a side
count as one measurement. More sides are finer, and slower."""
_ALIKE = np.radians(20.0)
"""The turn (rad) of an object at which the errors of its boxes have the correlation 1/2. A larger angle averages them out
later. The errors of a detector on three objects of YCB-Video fall to a half within 5 to 20 degrees."""
_WITHIN = 0.7
"""The variance of the mean error over a side, as a share of the variance from one direction: two directions in a side are 10
degrees apart in the mean, at which the correlation is 0.7. A larger share finds smaller errors."""
_SHARES = 81
"""The number of values of the share that are compared, from 0 to `_WIDEST` times the prior. More are finer, and slower."""
_WIDEST = 4.0
"""The largest share that is compared, in standard deviations of its prior. A larger value admits worse detectors."""
_LOOSE = 1.0
"""The standard deviation (m) of an object's place before its rays count. A larger value leaves more to the rays."""
_POOLED = 20.0
"""The number of rays at which the scatter of an object's rays and that of all rays have equal weight. A larger number trusts
the scatter of all rays for longer."""


@dataclass(frozen=True)
class _Sides:
    """C sides from which one object was seen.

    alike: (C, C) the covariance of the errors of two sides, over the variance of an error. mean: (A C,) rad, by how much the
    rays of a side miss the object along A axes. white: (A C,) rad, the standard deviation of this mean if each ray errs by
    itself. shift: (A C, 3) rad per m, its derivative by the object's place. offset: (A C, 3) rad, that by an offset of the
    boxes of this side, in sizes of the object. pull: (C, 3, 3) m, how far such an offset moves the object.
    """

    alike: Floats
    mean: Floats
    white: Floats
    shift: Floats
    offset: Floats
    pull: Floats


def with_box_offsets(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> Solution:
    """Return a solution whose covariances hold the errors that boxes share.

    The centre of an object's boxes is off by a share of the object's size: once from all sides, and once more as a
    function of the side. `rays.box_sigma` is the prior of the share. If it has its default, the rays tell the share.
    """
    estimate, prior = solution.estimate, settings.rays.box_sigma
    seen = _seen_sides(solution, cameras, settings) if prior > 0 else {}
    if not seen:
        return solution
    told = settings.noise.rays
    learnt = prior == type(settings.rays)().box_sigma if told == "auto" else told
    # Solved poses follow the boxes, but a pose in the plane cannot follow them up and down.
    if learnt and settings.mode == "joint":
        learnt = is_planar(solution.keyframes.map_T_base)
    share = _share(list(seen.values()), prior) if learnt else prior
    map_T_camera = estimate.map_T_base @ solution.keyframes.base_T_camera
    sizes = extents(solution.rays, solution.association, estimate.positions, map_T_camera, solution.keyframes, cameras)
    added = np.nan_to_num(sizes.prod(axis=1))[:, None, None] * np.eye(3)
    for j, sides in seen.items():
        added[j] += np.einsum("cik,cd,djk->ij", sides.pull, sides.alike, sides.pull)
    return replace(solution, estimate=replace(estimate, covariance=estimate.covariance + share**2 * added, box_offset=share))


def _seen_sides(solution: Solution, cameras: tuple[Camera, ...], settings: Settings) -> dict[int, _Sides]:
    """Return the sides of each object that has a place and boxes which show its size."""
    keyframes, estimate, association = solution.keyframes, solution.estimate, solution.association
    sees_size = np.array([c.sees_size for c in cameras])[keyframes.camera[solution.rays.keyframe]]
    placed = np.isfinite(estimate.covariance[:, 0, 0]) & np.isfinite(estimate.positions[:, 0])
    which = np.flatnonzero((estimate.weight > 0) & (association.object >= 0) & sees_size)
    which = which[placed[association.object[which]]]
    if not len(which):
        return {}
    rays, landmark, count = solution.rays.take(which), association.object[which], association.count
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    towards = estimate.positions[landmark] - origins
    distance = np.linalg.norm(towards, axis=1)
    size = np.sqrt(np.maximum(size_per_metre(rays, keyframes, cameras), 0.0).prod(axis=1))
    angle, place = (rays.sigma, 0.0) if settings.mode == "joint" else pose_noise(rays, keyframes, settings)
    noise = np.hypot(angle, place / distance)
    lattice = evenly_spread(_SIDES)
    pairs, cell = np.unique(
        np.column_stack([landmark, (directions @ lattice.T).argmax(axis=1)]), axis=0, return_inverse=True
    )
    cell, owner, axes = cell.ravel(), pairs[:, 0], _azimuth_elevation(lattice[pairs[:, 1]])
    flat = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weight = noise**-2
    off = np.einsum("rij,rj->ri", flat, towards) / distance[:, None]
    mean = _summed(axes, cell, weight, off[..., None])
    shift = _summed(axes, cell, weight, flat / distance[:, None, None])
    offset = _summed(axes, cell, weight, flat * size[:, None, None])
    total = np.bincount(cell, weight)
    mean, shift, offset = (part / total[:, None, None] for part in (mean, shift, offset))
    miss = np.einsum("ria,ri->ra", axes[cell], off) - mean[cell, :, 0]
    own, number = (np.bincount(landmark, values, count) for values in (weight * (miss**2).sum(axis=1), np.ones(len(cell))))
    free = 2 * (number - np.bincount(owner, minlength=count))
    scatter = (own + _POOLED * (own.sum() + 1) / (free.sum() + 1)) / (free + _POOLED)
    white = np.sqrt(scatter[owner] / total)

    # Eq. 1 adds up unit vectors, so that a ray pulls with the inverse of its deviation, not of the square of it.
    plain = settings.mode == "fixed" and settings.fixed.loss == "l1"
    strength = 1 / (noise * distance) if plain else (noise * distance) ** -2
    along = np.where(np.isfinite(rays.range) & (not plain), 1 / rays.range_sigma, 0.0) ** 2
    information = ray_information(directions, strength, along, landmark, count)
    held = np.linalg.eigvalsh(information)[:, 0] > 0
    inverse = np.zeros_like(information)
    inverse[held] = np.linalg.inv(information[held])
    pull = np.zeros((len(owner), 3, 3))
    np.add.at(pull, cell, (strength * size * distance)[:, None, None] * flat)
    pull = inverse[owner] @ pull

    towards_side = np.zeros((len(owner), 3))
    np.add.at(towards_side, cell, directions)
    towards_side /= np.linalg.norm(towards_side, axis=1, keepdims=True)
    first = 1 if settings.mode == "joint" else 0
    seen = {}
    for j in np.unique(owner).tolist():
        mine = np.flatnonzero(owner == j)
        used = slice(first, 2)
        turned = np.arccos(np.clip(towards_side[mine] @ towards_side[mine].T, -1, 1)) / _ALIKE
        seen[j] = _Sides(
            _WITHIN * 0.5**turned,
            mean[mine, used, 0].ravel(),
            np.repeat(white[mine], 2 - first),
            shift[mine, used].reshape(-1, 3),
            offset[mine, used].reshape(-1, 3),
            pull[mine],
        )
    return seen


def _summed(axes: Floats, cell: Ints, weight: Floats, values: Floats) -> Floats:
    """The weighted sums (C, 2, D) of values (R, 3, D) in each cell (R,), along the two axes (C, 3, 2) of the cell."""
    sums = np.zeros((len(axes), *values.shape[1:]))
    np.add.at(sums, cell, weight[:, None, None] * values)
    return np.einsum("cia,cid->cad", axes, sums)


def _share(seen: list[_Sides], prior: float) -> float:
    """Return the share of their size by which boxes err together: the root of the mean of its square, given the rays.

    The places of the objects are unknown, so that the restricted likelihood counts (Patterson and Thompson 1971). The prior
    is one half of a Gaussian (Gelman 2006), which lets the share vanish if the sides agree.
    """
    shares = np.linspace(0.0, _WIDEST * prior, _SHARES)
    likelihood = -0.5 * (shares / prior) ** 2
    for sides in seen:
        axes = len(sides.mean) // len(sides.alike)
        common = np.kron(sides.alike, np.ones((axes, axes))) * (sides.offset @ sides.offset.T)
        size, vectors = np.linalg.eigh(common / np.outer(sides.white, sides.white))
        mean, shift = (
            vectors.T @ (part / sides.white.reshape(-1, *(1,) * (part.ndim - 1))) for part in (sides.mean, sides.shift)
        )
        variance = 1 + shares[:, None] ** 2 * np.maximum(size, 0.0)
        matrix = np.einsum("ki,kj,sk->sij", shift, shift, 1 / variance) + np.eye(3) / _LOOSE**2
        vector = np.einsum("ki,k,sk->si", shift, mean, 1 / variance)
        explained = (vector * np.linalg.solve(matrix, vector[..., None])[..., 0]).sum(axis=1)
        squares = (mean**2 / variance + np.log(variance)).sum(axis=1)
        likelihood -= 0.5 * (squares + np.linalg.slogdet(matrix)[1] - explained)
    weight = np.exp(likelihood - likelihood.max())
    return float(np.sqrt((weight * shares**2).sum() / weight.sum()))


def _azimuth_elevation(directions: Floats) -> Floats:
    """Return the unit axes (n, 3, 2) of azimuth and elevation across each direction (n, 3), none of which is vertical."""
    azimuth = np.cross([0.0, 0.0, 1.0], directions)
    azimuth /= np.linalg.norm(azimuth, axis=1, keepdims=True)
    return np.stack([azimuth, np.cross(directions, azimuth)], axis=2)
