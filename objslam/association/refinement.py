"""Residuals of rays at points, and points that fit rays best, by iterated weighted least squares."""

import numpy as np

from objslam.association.observations import MIN_DEPTH, RANGE_LIMIT, Observations
from objslam.core.arrays import Floats, Ints
from objslam.core.rotation import dots
from objslam.core.statistics import HALF_RAY, grouped_quantiles, grouped_sums, order_by_group

RANGE_GAIN = 6.0
"""The amount by which a perfect range lowers the cost of a match. Another object would rarely have this range. A larger
value trusts ranges more."""
RANGE_LOSS = 4.0
"""The largest amount by which a wrong range raises the cost of a match. About one correct box in ten has a wrong range. With
a larger value, more correct boxes are lost."""
BEHIND = 1e6
"""The deviation, in standard deviations, of a point behind the camera. It is large, but finite."""
_HALF_RANGE = 3.0  # The scale of the robust range weight in squared deviations. With a larger one, wrong ranges pull more.
_DAMPING = 1e-6
"""The share of the information added in all directions. Unobserved directions then stay unchanged. A larger share slows the
refinement down."""
_ITERATIONS = 6  # The Gauss-Newton steps of a refinement. Few are enough, because association refines repeatedly.
_STILL = 1e-11
"""The longest step (m) of a point that counts as at rest. Rounding errors in a map of kilometres are as large. With a larger
value, positions are less exact, and the association depends more on its start."""
_PAIRS_AT_ONCE = 1 << 13
"""The most pairs of a ray and a point whose terms `refine` computes together, which fit into the processor's cache. A larger
number reads from memory, and a smaller one needs more calls."""
_FIRST, _SECOND = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
"""The rows and the columns of the six entries that determine a symmetric 3 x 3 matrix. The diagonal comes first."""


def variance(obs: Observations, distance: Floats, noise: Floats | float, of: Ints | slice = slice(None)) -> Floats:
    """Return the variance (E,) m^2, along each perpendicular axis, of the offset of a point from its ray. distance: (E,) m,
    from the camera to the points. noise: factor on the nominal noise. of: (E,) the rays, by default all."""
    return np.asarray(noise**2 * ((obs.sigma[of] * distance) ** 2 + obs.position_sigma**2))


def squared_offsets(obs: Observations, position: Floats, of: Ints | slice = slice(None)) -> tuple[Floats, Floats]:
    """Return the squared offset (E,) m^2 of each point from its ray, and its distance (E,) m from the camera. The offset is
    inf for a point behind the camera. position: (E, 3) or (3,) m. of: (E,) the ray of each point, by default all rays."""
    to = position - obs.origin[of]
    depth = np.einsum("ri,ri->r", to, obs.direction[of])
    distance2 = np.einsum("ri,ri->r", to, to)
    return np.where(depth > MIN_DEPTH, np.maximum(distance2 - depth**2, 0.0), np.inf), np.sqrt(distance2)


def normalised_residuals(obs: Observations, position: Floats, slack: float = 0.0, of: Ints | slice = slice(None)) -> Floats:
    """Return the offset (E,) of each point from its ray in standard deviations. It is inf for a point behind the camera.
    position, of: as in `squared_offsets`. slack: m, standard deviation of the origins in addition to their own."""
    off2, distance = squared_offsets(obs, position, of)
    return np.asarray(np.sqrt(off2 / (variance(obs, distance, 1.0, of) + slack**2)))


def information(obs: Observations, point: Floats) -> Floats:
    """Return the information (R, 3, 3) m^-2 of each ray about its point, (R, 3) or (3,)."""
    distance, n = np.linalg.norm(point - obs.origin, axis=1), obs.direction
    along = n[:, :, None] * n[:, None, :]
    across = (np.eye(3) - along) / (obs.sigma * np.maximum(distance, MIN_DEPTH))[:, None, None] ** 2
    ranged = np.isfinite(obs.range)
    if not ranged.any():
        return across
    weight = np.where(ranged, 1 / obs.range_sigma**2, 0.0)
    return across + np.nan_to_num(weight)[:, None, None] * along


def range_costs(
    obs: Observations, distance: Floats, variance_along: Floats | float = 0.0, of: Ints | slice = slice(None)
) -> Floats:
    """Return the cost (E,) of each ray's measured range, if its point is at `distance` (E,) m. The cost lies between
    -`RANGE_GAIN` and `RANGE_LOSS`. It is 0 for a ray without a range. variance_along: (E,) m^2, the variance of the point
    along the ray. of: (E,) the ray of each point, by default all rays."""
    measured = obs.range[of]
    if not np.isfinite(measured).any():
        return np.zeros(len(distance))
    with np.errstate(invalid="ignore"):
        wrong = (distance - measured) ** 2 / (obs.range_sigma[of] ** 2 + variance_along) - RANGE_GAIN
    return np.where(np.isfinite(wrong), np.minimum(wrong, RANGE_LOSS), 0.0)


def right_by_chance(obs: Observations) -> Floats:
    """Return for each ray the probability (R,) that its range is right for a point at the distance of another ray's range.
    It is 1 for a ray without a range."""
    known = np.isfinite(obs.range)
    distance, width, share = obs.range[known], RANGE_LIMIT * obs.range_sigma[known], np.ones(len(obs))
    first, last = np.searchsorted(np.sort(distance), [distance - width, distance + width])
    share[known] = (last - first) / max(len(distance), 1)
    return share


def ray_costs(
    obs: Observations, position: Floats, noise: Floats | float, gate: float, of: Ints | slice = slice(None)
) -> Floats:
    """Return -2 ln likelihood (E,) of rays for their points, up to a constant. It is at most `gate`, the cost of a ray
    without a landmark. position: (E, 3) or (3,) m. noise: (E,) or one factor on the nominal noise. of: (E,) the ray of each
    point, by default all rays."""
    off2, distance = squared_offsets(obs, position, of)
    cost = off2 / variance(obs, distance, noise, of) + 4 * np.log(noise) + range_costs(obs, distance, of=of)
    return np.asarray(np.minimum(cost, gate))


def refine(obs: Observations, ray: Ints, index: Ints, start: Floats, noise: Floats, iterations: int = _ITERATIONS) -> Floats:
    """Refine positions (N, 3) m of points from P pairs of a ray and its point. A ray may be in several pairs.

    ray, index: (P,) the observation and the point of each pair. start: (N, 3) m. A point keeps its start value in directions
    that its rays do not observe. noise: (N,) factor on the noise of the rays. iterations: the most steps.
    """
    count = len(start)
    order = order_by_group(index, count)
    ray, index = ray[order], index[order]
    # The axis of x, y and z comes first, because NumPy is slow if the last axis is short.
    origin, direction = (np.ascontiguousarray(rows.take(ray, axis=0).T) for rows in (obs.origin, obs.direction))
    measured, range_sigma = obs.range[ray], obs.range_sigma[ray]
    ranged = np.isfinite(measured)
    number, factor, position = np.bincount(index, minlength=count), noise[index], start.copy()
    some = np.flatnonzero(number)
    begin = (np.cumsum(number) - number)[some]
    slope, floor = (factor * obs.sigma[ray]) ** 2, (factor * obs.position_sigma) ** 2  # As in `variance`.
    # For each pair: six entries of a matrix, the pull of the ray, its weight, and the distance.
    each, sums = np.empty((11, len(ray))), np.zeros((11, count))
    for done in range(1, iterations + 1):
        for first in range(0, len(ray), _PAIRS_AT_ONCE):
            some_pairs = slice(first, first + _PAIRS_AT_ONCE)
            row, way = each[:, some_pairs], direction[:, some_pairs]
            to = position.T.take(index[some_pairs], axis=1) - origin[:, some_pairs]
            depth, distance2 = dots(to, way), np.maximum(dots(to, to), 1e-12)
            offset, row[10] = to - depth * way, np.sqrt(distance2)
            toward = to / row[10]
            row[9] = weight = 1 / (slope[some_pairs] * distance2 + floor[some_pairs] + dots(offset, offset) / HALF_RAY)
            row[6:9] = weight * (dots(toward, offset) * toward - offset)
            toward_weighted = -weight * toward
            for out, one, other in zip(row, _FIRST, _SECOND, strict=False):
                np.multiply(toward_weighted[one], toward[other], out=out)
            if ranged[some_pairs].any():
                sigma = range_sigma[some_pairs]
                beyond = np.where(ranged[some_pairs], measured[some_pairs] - depth, 0.0)
                along = np.where(ranged[some_pairs], 1 / sigma**2 / (1 + (beyond / sigma) ** 2 / _HALF_RANGE) ** 2, 0.0)
                row[6:9] += along * beyond * way
                row[:6] += along * way[_FIRST] * way[_SECOND]
        sums[:, some] = np.add.reduceat(each, begin, axis=1) if len(some) else 0.0
        sums[:3] += sums[9]
        sums[:3] += _DAMPING * (sums[0] + sums[1] + sums[2]) + 1e-12
        step = _solve_symmetric(sums[:6], sums[6:9])
        # With little parallax, full steps are unreliable. So no step is longer than the mean distance of the point.
        length, reach = np.sqrt(dots(step, step)), sums[10] / np.maximum(number, 1)
        position = position + (step * np.minimum(1.0, reach / np.maximum(length, 1e-12))).T
        moving = length > _STILL
        if 2 * number[moving].sum() < len(ray):  # Most rays belong to points that rest, and take no part in further steps.
            left = np.flatnonzero(moving[index])
            more = iterations - done if len(left) else 0
            return refine(obs, ray[left], index[left], position, noise, more) if more else position
    return position


def _solve_symmetric(matrices: Floats, right: Floats) -> Floats:
    """Return the solutions (3, N) of N symmetric systems by Cramer's rule, in a third of the time of LAPACK.

    matrices: (6, N) their entries in the order of `_FIRST` and `_SECOND`. The damping keeps the determinants above rounding
    errors. right: (3, N).
    """
    xx, yy, zz, xy, xz, yz = matrices
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    solution = np.stack([dots((a, b, c), right), dots((b, d, e), right), dots((c, e, f), right)])
    return np.asarray(solution / (xx * a + xy * b + xz * c))


def refine_damped(obs: Observations, number: Ints, start: Floats, damping: Floats, steps: int) -> tuple[Floats, Floats]:
    """Refine a few points faster than `refine`, and return positions (N, 3) m and covariances (N, 3, 3) m^2.

    obs: all rays of the first point, then all rays of the second point, and so on. number: (N,) number of rays of each
    point, at least 1. start: (N, 3) m. damping: (N, 3, 3) m^-2, information that keeps a point at its position in each step.
    steps: number of Gauss-Newton steps.
    """
    index, begin, position = np.repeat(np.arange(len(number)), number), np.cumsum(number) - number, start
    for _ in range(steps):
        off = np.minimum(normalised_residuals(obs, position[index]), 1e3)
        gain = information(obs, position[index]) / (1 + off**2 / HALF_RAY)[:, None, None]
        to = position[index] - obs.origin
        depth = np.einsum("ri,ri->r", to, obs.direction)
        beyond = np.where(np.isfinite(obs.range), obs.range - depth, 0.0)
        target = (depth + beyond)[:, None] * obs.direction - to
        pull = np.add.reduceat(gain @ target[:, :, None], begin)
        position = position + np.linalg.solve(damping + np.add.reduceat(gain, begin), pull)[:, :, 0]
    total = damping + np.add.reduceat(information(obs, position[index]), begin)
    return position, np.asarray(np.linalg.inv(total))


def velocity_gain(
    obs: Observations, ray: Ints, index: Ints, position: Floats, noise: Floats, stamps: Floats
) -> tuple[Floats, Floats]:
    """Fit a velocity to each point. Return the share (N,) of the squared deviations that the velocity explains, and the
    distance (N,) m that each point moves while its rays see it.

    Pairs and points are as in `refine`. stamps: (P,) s, the times of the rays.
    """
    count = len(position)
    origin, direction = obs.origin[ray], obs.direction[ray]
    time = _standard(stamps, index, count)
    to = position[index] - origin
    distance, across = _across(to)
    spread = variance(obs, distance, noise[index], ray)
    offset = to - np.einsum("ri,ri->r", to, direction)[:, None] * direction
    weighted = across / spread[:, None, None]
    pull = -(weighted @ offset[:, :, None])[:, :, 0]
    blocks = [
        grouped_sums((weighted * (time**p)[:, None, None]).reshape(-1, 9), index, count).reshape(-1, 3, 3) for p in range(3)
    ]
    hessian = np.block([[blocks[0], blocks[1]], [blocks[1], blocks[2]]])
    hessian += (1e-6 * np.trace(hessian, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(6)
    right = np.concatenate([grouped_sums(pull, index, count), grouped_sums(pull * time[:, None], index, count)], axis=1)
    moving = np.linalg.solve(hessian, right[:, :, None])[:, :, 0]
    resting = np.linalg.solve(hessian[:, :3, :3], right[:, :3, None])[:, :, 0]
    gain = (moving * right).sum(axis=1) - (resting * right[:, :3]).sum(axis=1)
    total = np.maximum(np.bincount(index, np.einsum("pi,pi->p", offset, offset) / spread, count), 1e-9)
    first, last = grouped_quantiles(time, index, count, (0.0, 1.0))
    return gain / total, np.nan_to_num(np.linalg.norm(moving[:, 3:], axis=1) * (last - first))


def _across(to: Floats) -> tuple[Floats, Floats]:
    """Return the lengths (P,) m of offsets (P, 3) m from cameras, and projections (P, 3, 3) perpendicular to them.

    Residuals are angles, which do not change along the line of sight. So a point gains nothing by a motion along this line.
    """
    distance = np.maximum(np.linalg.norm(to, axis=1), 1e-6)
    toward = to / distance[:, None]
    return distance, np.eye(3) - toward[:, :, None] * toward[:, None, :]


def _standard(time: Floats, index: Ints, count: int) -> Floats:
    """Standardise the times (P,) of each point to mean 0 and standard deviation 1."""
    number = np.maximum(np.bincount(index, minlength=count), 1)
    centred = time - (np.bincount(index, time, count) / number)[index]
    spread = np.sqrt(np.bincount(index, centred**2, count) / number)
    return np.asarray(centred / np.maximum(spread[index], 1e-9))
