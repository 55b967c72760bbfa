"""Triangulate all objects of a log at once from rays with known poses, by Eq. 1 of Staszak & Belter on the rays that agree.

Inputs and outputs are numpy float64 arrays. The work itself is done in numpy or, for a large batch on a
machine with CUDA, in torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from objslam import config
from objslam.core.array_module import Backend, Tensor, array_backend, as_numpy, as_tensor, group_sum, length, module_of
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.status import is_resolved
from objslam.triangulation import ac_ransac
from objslam.triangulation import covariance as spread_of
from objslam.triangulation.bundle import Bundle
from objslam.triangulation.lines import Lines
from objslam.triangulation.point_to_lines import least_squares, minimise_distances
from objslam.triangulation.range_consensus import agreeing_with_ranges, contradicted

_LARGE = 200_000
"""The number of rays from which on CUDA is used, if there is a CUDA device. With fewer rays, numpy on one core is as fast,
because the import of torch takes 1.4 s. Without this import, 20,000 rays took 0.18 s in numpy and 0.08 s on an H100, and
200,000 rays took 2.0 s and 0.25 s."""


@dataclass(frozen=True)
class Triangulation:
    """N objects from one batch of R rays, in the coordinate frame of the rays (map).

    positions: (N, 3) m, NaN for an object without rays. If the rays do not fix an object, its position is a point on their
    mean ray, 1 m ahead if no range was measured. covariance: (N, 3, 3) m^2, NaN if the rays do not determine it. ok: (N,)
    whether the position is reliable. parallax: (N,) rad, the widest angle between inlier rays as undirected lines. rms: (N,)
    rad, the root mean square angle between the inlier rays and the object. distance: (R,) m, between a ray and its object as
    in Eq. 1, NaN for a ray without object. weight: (R,) 1 for an inlier, else 0. counts: (N,) the number of inlier rays.
    iterations: the number of solver iterations. gradient: (N,) the norm of the gradient of Eq. 1 at the solution. If rays
    pass through the solution, it is the norm of the smallest subgradient. It is NaN for a position that is not from Eq. 1.
    """

    positions: Floats
    covariance: Floats
    ok: Bools
    parallax: Floats
    rms: Floats
    distance: Floats
    weight: Floats
    counts: Ints
    iterations: int
    gradient: Floats


def triangulate(
    origins: ArrayLike,
    directions: ArrayLike,
    object_index: ArrayLike,
    count: int,
    sigma: ArrayLike,
    settings: config.Triangulation,
    *,
    seed: int = 0,
    ranges: ArrayLike | None = None,
    range_sigma: ArrayLike | None = None,
    range_bias: ArrayLike = 0.0,
    position_sigma: float = 0.0,
    judged: ArrayLike | None = None,
) -> Triangulation:
    """Triangulate all objects of a batch by Eq. 1 on the rays that agree, with covariance and status.

    An object is ok under three conditions. At least 2 rays agree more closely than by chance. The parallax of the agreeing
    rays and the relative precision meet the limits of the settings. The object lies ahead of most of the agreeing rays. A
    measured range replaces the parallax. Without `settings.consensus`, all rays are used, and chance is not judged. Ranges
    are fused only if the rays of an object fail the limits, or if its ranges together are more precise than its rays. Other
    objects keep the position of Eq. 1, because ranges end on the surface of an object, but rays meet inside. The result for
    an object does not depend on other objects or on the order of the rays.

    Args:
        origins, directions: (R, 3) m, and (R, 3) of any length above 0.
        object_index: (R,) the object of each ray, -1 for none, of `count` objects.
        sigma: (R,) or one number, rad, the noise of a ray's angle along each perpendicular axis.
        seed: the seed for the random choice of pairs of rays.
        ranges: (R,) m along the rays, NaN if unknown. range_sigma: (R,) or one number, m, the noise of the ranges.
        range_bias: (R,) or one number, m, the standard deviation of the error that all ranges of an object share.
        position_sigma: m, the noise of the origins along each axis.
        judged: (N,) whether the association has found that the rays of an object do not meet by chance. Such an object can
            be ok with few, noisy rays.
    Raises:
        ValueError: the arrays do not fit together or are not finite.
        ConfigError: the device does not exist.
    """
    m, n, index = _rays(origins, directions, object_index, count)
    noise = _positive(sigma, len(m), "sigma")
    known = spread = shared = None
    if ranges is not None:
        if range_sigma is None:
            raise ValueError("ranges need their range_sigma")
        known = _vector(ranges, len(m), "ranges")
        spread = _positive(range_sigma, len(m), "range_sigma", known)
        shared = np.broadcast_to(np.asarray(range_bias, dtype=np.float64), (len(m),))
        if not (shared[np.isfinite(known)] >= 0).all():
            raise ValueError("range_bias must be at least 0")
    with array_backend(settings.device, len(m) >= _LARGE) as backend:
        given = known, spread, shared, np.broadcast_to(False if judged is None else np.asarray(judged, dtype=bool), count)
        found = _triangulate(m, n, index, count, noise, position_sigma, settings, seed, *given, backend)
        if known is None or spread is None or shared is None or not settings.consensus:
            return found
        measured = np.where(known > 0, known, np.nan)
        left = _left(found, m, n, index, noise, position_sigma, measured, np.hypot(spread, shared))
        if not (left >= 0).any():
            return found
        again = _triangulate(m, n, left, count, noise, position_sigma, settings, seed, *given, backend)
        return _changed(found, again, left, index)


def _left(
    found: Triangulation,
    m: Floats,
    n: Floats,
    index: Ints,
    noise: Floats,
    position_sigma: float,
    ranges: Floats,
    sigma: Floats,
) -> Ints:
    """Return the object (R,) of each ray that is triangulated again, -1 for all other rays.

    Such rays are of objects whose bearings meet far from the ends of their ranges. Rays that cause this error are left out.
    m, n: (R, 3) the origins, m, and the unit directions. sigma: (R,) m, the noise of the ranges. Other arguments are as in
    `triangulate`.
    """
    left = np.full(len(index), -1)
    away = np.full(len(index), np.nan)
    away[index >= 0] = np.linalg.norm(found.positions[index[index >= 0]] - m[index >= 0], axis=1)
    far = contradicted(index, found.weight > 0, away, ranges, sigma, len(found.ok))
    if not len(far):
        return left
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.column_stack([far, far + 1]))
    for j, (begin, end) in zip(far.tolist(), bounds.tolist(), strict=True):
        mine = order[begin:end]
        agree = agreeing_with_ranges(m[mine], n[mine], noise[mine], ranges[mine], sigma[mine], position_sigma)
        left[mine if agree is None else mine[agree]] = -1 if agree is None else j
    return left


def _changed(found: Triangulation, again: Triangulation, left: Ints, index: Ints) -> Triangulation:
    """Return the triangulation `found` with those objects from `again` that have rays in `left` (R,)."""
    mine = np.isin(np.arange(len(found.ok)), left)
    rays = np.append(mine, False)[index]
    return Triangulation(
        positions=np.where(mine[:, None], again.positions, found.positions),
        covariance=np.where(mine[:, None, None], again.covariance, found.covariance),
        ok=np.where(mine, again.ok, found.ok),
        parallax=np.where(mine, again.parallax, found.parallax),
        rms=np.where(mine, again.rms, found.rms),
        distance=np.where(rays, again.distance, found.distance),
        weight=np.where(rays, again.weight, found.weight),
        counts=np.where(mine, again.counts, found.counts),
        iterations=found.iterations + again.iterations,
        gradient=np.where(mine, again.gradient, found.gradient),
    )


def _triangulate(
    m: Floats,
    n: Floats,
    index: Ints,
    count: int,
    noise: Floats,
    position_sigma: float,
    settings: config.Triangulation,
    seed: int,
    ranges: Floats | None,
    range_sigma: Floats | None,
    range_bias: Floats | None,
    judged: Bools,
    backend: Backend,
) -> Triangulation:
    """Triangulate rays that are already checked. The arguments are as in `triangulate`."""
    where, base, bundle = _sorted_bundle(m, n, index, count, noise, position_sigma, backend)
    xp = bundle.xp
    if settings.consensus:
        jitter = as_tensor(np.random.default_rng(seed).random(settings.hypotheses), backend)
        sure = as_tensor(judged, backend)
        result, use, log_nfa = ac_ransac.fit_consensus(bundle, settings.hypotheses, jitter, sure)
        by_chance = (log_nfa >= 0) & ~sure
    else:
        use = xp.ones_like(bundle.index, dtype=xp.bool)
        result = minimise_distances(bundle)
        by_chance = xp.zeros_like(result.determined)
    point, gradient = result.point, result.gradient
    covariance = spread_of.covariance(bundle, use, point)
    covariance = xp.where(result.determined[:, None, None], covariance, xp.nan)
    angle = spread_of.parallax(bundle, use)
    counts = xp.bincount(bundle.index[use], minlength=count)

    def resolved(point: Tensor, covariance: Tensor, ranged: Tensor) -> Tensor:
        sigma, reach = spread_of.largest_sigma(covariance), spread_of.reach(bundle, use, point)
        return is_resolved(sigma, reach, counts, angle, ranged, settings) & spread_of.lies_ahead(bundle, use, point)

    carried = resolved(point, covariance, xp.zeros_like(by_chance))
    if ranges is not None and range_sigma is not None and range_bias is not None:
        spread, bias = (as_tensor(one[where], backend) for one in (range_sigma, range_bias))
        measured = as_tensor(np.where(ranges > 0, ranges, np.nan)[where], backend)
        fused, fused_covariance = spread_of.fuse_ranges(bundle, use, measured, spread, bias)
        ranged = xp.isfinite(measured)
        here = bundle.index[ranged]
        spreads, biases = (spread_of.object_median(one[ranged], here, count) for one in (spread, bias))
        number = xp.bincount(here, minlength=count).clip(min=1)
        all_ranges = xp.hypot(spreads / number**0.5, biases)  # The error that all ranges share is also in their mean.
        taken = xp.isfinite(fused[:, 0]) & ~(carried & (spread_of.largest_sigma(covariance) <= all_ranges))
        point = xp.where(taken[:, None], fused, point)
        covariance = xp.where(taken[:, None, None], fused_covariance, covariance)
        gradient = xp.where(taken, xp.nan, gradient)
        carried = resolved(point, covariance, taken)
    weight = np.zeros(len(m))
    weight[where] = as_numpy(use)
    positions = as_numpy(base + point)
    distance, off = _miss(m, n, index, positions)
    total = np.bincount(index[weight > 0], off[weight > 0] ** 2, minlength=count)
    number = as_numpy(counts)
    return Triangulation(
        positions=positions,
        covariance=as_numpy(covariance),
        ok=as_numpy(carried & ~by_chance),
        parallax=as_numpy(angle),
        rms=np.sqrt(np.divide(total, number, out=np.full(count, np.nan), where=number > 0)),
        distance=distance,
        weight=weight,
        counts=number,
        iterations=result.iterations,
        gradient=as_numpy(gradient),
    )


def solve_eq1(
    origins: ArrayLike, directions: ArrayLike, object_index: ArrayLike, count: int, *, device: config.Device = "auto"
) -> tuple[Floats, int, Floats]:
    """Solve Eq. 1 for each object, argmin over o of sum_i ||(o - m_i) x n_i|| / ||n_i||, to machine precision.

    o is the point, m_i the origin and n_i the direction of ray i. Arguments are as in `triangulate`. An object whose rays
    fix no point gets the point of `least_squares`. For two rays, each point between them on their common perpendicular is
    optimal, and the result is the midpoint.

    Returns:
        The points (N, 3) m, the number of iterations, and the norm (N,) of the gradient. The norm is NaN if the rays fix no
        point. If rays pass through the solution, it is the norm of the smallest subgradient. So 0 always proves the optimum.
    """
    m, n, index = _rays(origins, directions, object_index, count)
    with array_backend(device, len(m) >= _LARGE) as backend:
        _, base, bundle = _bundle(m, n, index, count, np.ones(len(m)), 0.0, backend)
        result = minimise_distances(bundle)
        return as_numpy(base + result.point), result.iterations, as_numpy(result.gradient)


def _rays(origins: ArrayLike, directions: ArrayLike, object_index: ArrayLike, count: int) -> tuple[Floats, Floats, Ints]:
    """Check origins, unit directions and object indices, and return them as arrays."""
    m, n = np.asarray(origins, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    index = np.asarray(object_index)
    if index.size == 0:
        index = index.astype(np.int64)
    if m.ndim != 2 or m.shape[1] != 3 or n.shape != m.shape or index.shape != m.shape[:1]:
        raise ValueError(f"rays need (R,3) origins, (R,3) directions, (R,) objects, not {m.shape}, {n.shape}, {index.shape}")
    if not np.issubdtype(index.dtype, np.integer) or (len(index) and not -1 <= index.min() <= index.max() < count):
        raise ValueError(f"object_index must hold integers from -1 to {count - 1}")
    norm = np.sqrt(np.einsum("ri,ri->r", n, n))[:, None]
    if not (np.isfinite(m).all() and np.isfinite(norm).all() and (norm > 0).all()):
        raise ValueError("rays need finite origins and directions of a length above 0")
    return m, n / norm, index.astype(np.int64)


def _vector(values: ArrayLike, length: int, name: str) -> Floats:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape not in ((), (length,)):
        raise ValueError(f"{name} must be one number or ({length},), not {vector.shape}")
    return np.broadcast_to(vector, length)


def _positive(values: ArrayLike, length: int, name: str, needed: Floats | None = None) -> Floats:
    """Return one value (R,) for each ray. ValueError if a value is not finite and above 0.

    A ray whose `needed` (R,) is not finite needs no value. If its value is wrong, it becomes 1.
    """
    vector = _vector(values, length, name)
    fine = np.isfinite(vector) & (vector > 0)
    if not (fine if needed is None else fine | ~np.isfinite(needed)).all():
        raise ValueError(f"{name} must be finite and above 0")
    return np.where(fine, vector, 1.0)


def _bundle(
    m: Floats, n: Floats, index: Ints, count: int, sigma: Floats, position_sigma: float, backend: Backend
) -> tuple[Ints, Tensor, Bundle]:
    """Return the indices of the rays with an object, the mean ray origin (N, 3) of each object, and their bundle."""
    where = np.arange(len(index))
    if len(index) and (index[0] < 0 or (index[1:] < index[:-1]).any()):
        where = np.argsort(index, stable=True)
        where = where[np.searchsorted(index[where], 0) :]
        m, n, sigma, index = m[where], n[where], sigma[where], index[where]
    origin, direction, noise, objects = (as_tensor(v, backend) for v in (m, n, sigma, index))
    number = as_tensor(np.bincount(index, minlength=count), backend)
    base = group_sum(origin, objects, count) / number[:, None]
    return where, base, Bundle(origin - base[objects], direction, noise, position_sigma, objects, number, module_of(origin))


def _sorted_bundle(
    m: Floats, n: Floats, index: Ints, count: int, sigma: Floats, position_sigma: float, backend: Backend
) -> tuple[Ints, Tensor, Bundle]:
    """Return the same as `_bundle`, but with the rays of each object sorted by their distance from its closed-form point.

    So the order of the input does not change which pairs are tried.
    """
    where, base, rays = _bundle(m, n, index, count, sigma, position_sigma, backend)
    xp = rays.xp
    points, _ = least_squares(rays)
    objects = rays.index
    order = xp.argsort(length(Lines.through(rays.origin - points[objects], rays.direction, objects, count, xp).foot))
    order = order[xp.argsort(objects[order], stable=True)]
    bundle = replace(rays, origin=rays.origin[order], direction=rays.direction[order], sigma=rays.sigma[order])
    return where[as_numpy(order)], base, bundle


def _miss(m: Floats, n: Floats, index: Ints, positions: Floats) -> tuple[Floats, Floats]:
    """Return the distance (R,) m and the angle (R,) rad between each ray and its object. NaN for a ray without object."""
    to_object = np.full_like(m, np.nan)
    has = index >= 0
    to_object[has] = positions[index[has]] - m[has]
    distance = np.linalg.norm(np.cross(to_object, n), axis=1)
    return distance, np.arctan2(distance, (to_object * n).sum(axis=1))
