"""Objects from rays with known poses: Eq. 1 of Staszak & Belter on the rays that agree, for all objects of a log at once.

Arrays go in and come out as numpy float64; torch does the work and is imported with the first call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from objslam import config
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.status import is_resolved
from objslam.core.torch_threads import one_torch_thread, torch_device

if TYPE_CHECKING:
    import torch

    from objslam.triangulation.ac_ransac import Bundle

_CUDA_PAYS = 200_000
"""The number of rays from which the device "auto" is CUDA. One CPU core solves Eq. 1 for 50,000 rays in 0.12 s and
triangulates them in 0.6 s: well below this, CUDA's start alone takes longer. The crossing point depends on the card."""


@dataclass(frozen=True)
class Triangulation:
    """Objects of one batch of rays, N objects and R rays, all in the frame of the rays (map).

    positions: (N, 3) m; where its rays do not fix an object, a point on their mean (1 m ahead where no range was measured);
    NaN without rays. covariance: (N, 3, 3) m^2, NaN where not determined. ok: (N,) whether the position is
    one to rely on. parallax: (N,) rad, the widest angle between inlier rays, as lines. rms: (N,) rad, angle off the inlier
    rays. distance: (R,) m, Eq. 1's distance of a ray to its object, NaN without object. weight: (R,) 1 inlier, 0 rejected
    or without object. counts: (N,) inlier rays. iterations: of the solver. gradient: (N,) norm of Eq. 1's gradient at the
    solution (the smallest subgradient where rays pass through it), NaN where Eq. 1 did not give the position.
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


@one_torch_thread()
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
    position_sigma: float = 0.0,
) -> Triangulation:
    """Triangulate all objects of a batch: consensus, Eq. 1 on the rays that agree, and how far to rely on the result.

    An object is ok if at least 2 rays agree, more closely than by chance, with the parallax and the relative precision of
    the settings, and if it lies ahead of most of them. Ranges are fused with the rays where the rays alone miss that, or
    where a single range says more than all of them. Else Eq. 1's position stands, because a range ends on an object's
    surface and its rays meet inside. An object's answer depends neither on other objects nor on the order of the rays.

    Args:
        origins, directions: (R, 3) m, and (R, 3) of any length but 0.
        object_index: (R,) the object of each ray, -1 none, of `count` objects.
        sigma: (R,) or one, rad, of a ray's angle along each axis across it.
        ranges: (R,) m along the rays, NaN where unknown, with range_sigma (R,) or one, m.
        position_sigma: m, of the origins.
    Raises:
        ValueError: when arrays do not fit or are not finite.
        ConfigError: when the device is not there.
    """
    import torch

    from objslam.triangulation import ac_ransac
    from objslam.triangulation import covariance as spread_of

    m, n, index = _rays(origins, directions, object_index, count)
    noise = _positive(sigma, len(m), "sigma")
    where, base, bundle = _bundle(m, n, index, count, noise, position_sigma, settings.device)
    if settings.consensus:
        result, use, log_nfa = ac_ransac.fit_consensus(bundle, settings.hypotheses, _jitter(seed, bundle, settings))
        by_chance = log_nfa >= 0
    else:
        use = torch.ones(len(where), dtype=torch.bool, device=base.device)
        result = ac_ransac.solve_points(bundle, use)
        by_chance = torch.zeros_like(result.determined)
    point, gradient = result.point, result.gradient
    covariance = spread_of.covariance(bundle, use, point)
    covariance = torch.where(result.determined[:, None, None], covariance, torch.nan)
    angle = spread_of.parallax(bundle, use)
    counts = torch.bincount(bundle.index[use], minlength=count)

    def resolved(point: torch.Tensor, covariance: torch.Tensor, ranged: torch.Tensor) -> torch.Tensor:
        sigma, reach = spread_of.largest_sigma(covariance), spread_of.reach(bundle, use, point)
        return is_resolved(sigma, reach, counts, angle, ranged, settings) & spread_of.lies_ahead(bundle, use, point)

    carried = resolved(point, covariance, torch.zeros_like(by_chance))
    if ranges is not None:
        known = _vector(ranges, len(m), "ranges")
        if range_sigma is None:
            raise ValueError("ranges need their range_sigma")
        spread = torch.from_numpy(_positive(range_sigma, len(m), "range_sigma", known)[where]).to(base.device)
        measured = torch.from_numpy(np.where(known > 0, known, np.nan)[where]).to(base.device)
        fused, fused_covariance = spread_of.fuse_ranges(bundle, use, measured, spread)
        one_range = spread_of.object_median(spread[measured.isfinite()], bundle.index[measured.isfinite()], count)
        taken = fused[:, 0].isfinite() & ~(carried & (spread_of.largest_sigma(covariance) <= one_range))
        point = torch.where(taken[:, None], fused, point)
        covariance = torch.where(taken[:, None, None], fused_covariance, covariance)
        gradient = torch.where(taken, torch.nan, gradient)
        carried = resolved(point, covariance, taken)
    weight = np.zeros(len(m))
    weight[where] = use.double().cpu().numpy()
    positions = (base + point).cpu().numpy()
    distance, off = _miss(m, n, index, positions)
    return Triangulation(
        positions=positions,
        covariance=covariance.cpu().numpy(),
        ok=(carried & ~by_chance).cpu().numpy(),
        parallax=angle.cpu().numpy(),
        rms=_rms(off, weight, index, count),
        distance=distance,
        weight=weight,
        counts=counts.cpu().numpy(),
        iterations=result.iterations,
        gradient=gradient.cpu().numpy(),
    )


def closed_form(
    origins: ArrayLike, directions: ArrayLike, object_index: ArrayLike, count: int, *, device: config.Device = "auto"
) -> tuple[Floats, Bools]:
    """The points (N, 3) m with the smallest sum of squared distances to their rays' lines, and which are determined (N,).

    Arguments are as in `triangulate`. Parallel rays, or a single one, fix no point: then it is 1 m ahead of the mean origin
    on the mean ray. It is NaN without rays.
    """
    from objslam.triangulation import point_to_lines

    m, n, index = _rays(origins, directions, object_index, count)
    _, base, bundle = _bundle(m, n, index, count, np.ones(len(m)), 0.0, device)
    points, determined = point_to_lines.least_squares(bundle.origin, bundle.direction, bundle.index, count)
    return (base + points).cpu().numpy(), determined.cpu().numpy()


def solve_eq1(
    origins: ArrayLike,
    directions: ArrayLike,
    object_index: ArrayLike,
    count: int,
    start: ArrayLike | None = None,
    *,
    device: config.Device = "auto",
) -> tuple[Floats, int, Floats]:
    """Eq. 1 for each object, argmin over o of sum_i ||(o - m_i) x n_i|| / ||n_i||, to machine precision.

    Arguments are as in `triangulate`; start: (N, 3) m, used where it is better than the `closed_form`. Objects that their
    rays do not fix get the closed form's point. The optimum of two rays is their whole common perpendicular: its midpoint is
    returned.

    Returns:
        The points (N, 3) m, the solver's iterations, and the norm (N,) of the gradient, NaN where rays do not fix a point.
        Where rays pass through the solution it is that of the smallest subgradient, so that 0 always proves the optimum.
    """
    import torch

    from objslam.triangulation import ac_ransac

    m, n, index = _rays(origins, directions, object_index, count)
    where, base, bundle = _bundle(m, n, index, count, np.ones(len(m)), 0.0, device)
    first = None
    if start is not None:
        given = np.ascontiguousarray(start, dtype=np.float64)
        if given.shape != (count, 3):
            raise ValueError(f"start must be ({count}, 3), not {given.shape}")
        first = torch.from_numpy(given).to(base.device) - base
    result = ac_ransac.solve_points(bundle, torch.ones(len(where), dtype=torch.bool, device=base.device), first)
    return (base + result.point).cpu().numpy(), result.iterations, result.gradient.cpu().numpy()


def consensus(
    origins: ArrayLike,
    directions: ArrayLike,
    object_index: ArrayLike,
    count: int,
    sigma: ArrayLike,
    settings: config.Triangulation,
    *,
    seed: int = 0,
    position_sigma: float = 0.0,
) -> tuple[Bools, Floats]:
    """Which rays agree on their object: inlier (R,), and for each object (N,) the log of the number of such agreements that
    chance would make (NFA), below 0 where it would not. Arguments are as in `triangulate`; `ac_ransac` says how.
    """
    from objslam.triangulation import ac_ransac

    m, n, index = _rays(origins, directions, object_index, count)
    noise = _positive(sigma, len(m), "sigma")
    where, _, bundle = _bundle(m, n, index, count, noise, position_sigma, settings.device)
    _, use, log_nfa = ac_ransac.fit_consensus(bundle, settings.hypotheses, _jitter(seed, bundle, settings))
    inlier = np.zeros(len(m), dtype=bool)
    inlier[where] = use.cpu().numpy()
    return inlier, log_nfa.cpu().numpy()


def _rays(origins: ArrayLike, directions: ArrayLike, object_index: ArrayLike, count: int) -> tuple[Floats, Floats, Ints]:
    """Origins, unit directions and object indices, checked."""
    m = np.asarray(origins, dtype=np.float64)
    n = np.asarray(directions, dtype=np.float64)
    index = np.asarray(object_index)
    if index.size == 0:
        index = index.astype(np.int64)
    if m.ndim != 2 or m.shape[1] != 3 or n.shape != m.shape or index.shape != m.shape[:1]:
        raise ValueError(f"rays need (R,3) origins, (R,3) directions, (R,) objects, not {m.shape}, {n.shape}, {index.shape}")
    if not np.issubdtype(index.dtype, np.integer) or (len(index) and not -1 <= index.min() <= index.max() < count):
        raise ValueError(f"object_index must hold integers from -1 to {count - 1}")
    length = np.linalg.norm(n, axis=1, keepdims=True)
    if not (np.isfinite(m).all() and np.isfinite(length).all() and (length > 0).all()):
        raise ValueError("rays need finite origins and directions of a length above 0")
    return m, n / length, index.astype(np.int64)


def _vector(values: ArrayLike, length: int, name: str) -> Floats:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape not in ((), (length,)):
        raise ValueError(f"{name} must be one number or ({length},), not {vector.shape}")
    return np.broadcast_to(vector, length)


def _positive(values: ArrayLike, length: int, name: str, needed: Floats | None = None) -> Floats:
    """One value a ray, finite and above 0 wherever `needed` (by default everywhere) is a number."""
    vector = _vector(values, length, name)
    fine = np.isfinite(vector) & (vector > 0)
    if not (fine if needed is None else fine | ~np.isfinite(needed)).all():
        raise ValueError(f"{name} must be finite and above 0")
    return np.where(fine, vector, 1.0)


def _bundle(
    m: Floats, n: Floats, index: Ints, count: int, sigma: Floats, position_sigma: float, device: config.Device
) -> tuple[Ints, torch.Tensor, Bundle]:
    """The rays that have an object, in the bundle's order; each object's mean origin (N, 3); the rays relative to it."""
    import torch

    from objslam.triangulation import point_to_lines
    from objslam.triangulation.ac_ransac import Bundle

    where = np.flatnonzero(index >= 0)
    place = torch_device(device, len(where) >= _CUDA_PAYS)
    origin, direction, noise = (torch.from_numpy(v[where]).to(place) for v in (m, n, sigma))
    number = torch.from_numpy(np.bincount(index[where], minlength=count)).to(place)
    objects = torch.from_numpy(index[where]).to(place)
    base = point_to_lines.object_sum(origin, objects, count) / number[:, None]
    origin = origin - base[objects]
    # sorted by how far they pass the closed form: then neither the rays' order nor the frame changes which pairs are tried
    points, _ = point_to_lines.least_squares(origin, direction, objects, count)
    order = torch.argsort(point_to_lines.Lines.through(origin - points[objects], direction, objects, count).foot.norm(dim=1))
    order = order[torch.argsort(objects[order], stable=True)]
    bundle = Bundle(origin[order], direction[order], noise[order], position_sigma, objects[order], number)
    return where[order.cpu().numpy()], base, bundle


def _jitter(seed: int, bundle: Bundle, settings: config.Triangulation) -> torch.Tensor:
    import torch

    return torch.from_numpy(np.random.default_rng(seed).random(settings.hypotheses)).to(bundle.origin.device)


def _miss(m: Floats, n: Floats, index: Ints, positions: Floats) -> tuple[Floats, Floats]:
    """How far rays pass their object: distance (R,) m from the line, angle (R,) rad from the half line; NaN without one."""
    to_object = np.full_like(m, np.nan)
    has = index >= 0
    to_object[has] = positions[index[has]] - m[has]
    distance = np.linalg.norm(np.cross(to_object, n), axis=1)
    return distance, np.arctan2(distance, (to_object * n).sum(axis=1))


def _rms(off: Floats, weight: Floats, index: Ints, count: int) -> Floats:
    inlier = weight > 0
    total = np.bincount(index[inlier], off[inlier] ** 2, minlength=count)
    number = np.bincount(index[inlier], minlength=count)
    return np.sqrt(np.divide(total, number, out=np.full(count, np.nan), where=number > 0))
