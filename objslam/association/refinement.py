"""How far rays pass a point, and the points that they pass closest, by iterated weighted least squares."""

from __future__ import annotations

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations
from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import HALF_RAY, grouped_quantiles

RANGE_GAIN = 6.0
"""What a range that fits perfectly takes off a match's cost: something else has its range anywhere within some metres."""
RANGE_LOSS = 4.0
"""The most that a wrong range adds to a match's cost: one right box in ten or so has a wrong range."""
BEHIND = 1e6
"""The standard deviations that stand for a point behind the camera where a finite number is needed."""
_HALF_RANGE = 3.0  # The scale, in squared deviations, of the robust weight of a range; larger lets wrong ranges pull harder.
_DAMPING = 1e-6  # The share of the information added to all directions: what rays do not fix stays where it is.
_ITERATIONS = 6  # The Gauss-Newton steps of a refinement; association calls it again and again, so few are enough.


def variance(obs: Observations, distance: Floats, noise: Floats | float, of: Ints | slice = slice(None)) -> Floats:
    """Variance (E,) m^2 per axis across of a point's offset from its ray, `distance` (E,) m away; of: (E,) which rays."""
    return np.asarray(noise**2 * ((obs.sigma[of] * distance) ** 2 + obs.position_sigma**2))


def squared_offsets(obs: Observations, position: Floats, of: Ints | slice = slice(None)) -> tuple[Floats, Floats]:
    """How far each ray passes its point, (E, 3) or (3,), squared, inf where that is behind, and its distance (E,) m."""
    to = position - obs.origin[of]
    depth = np.einsum("ri,ri->r", to, obs.direction[of])
    distance2 = np.einsum("ri,ri->r", to, to)
    return np.where(depth > MIN_DEPTH, np.maximum(distance2 - depth**2, 0.0), np.inf), np.sqrt(distance2)


def normalised_residuals(obs: Observations, position: Floats, slack: float = 0.0, of: Ints | slice = slice(None)) -> Floats:
    """By how many standard deviations (E,) each ray passes its point, (E, 3) or (3,); inf where that is behind.

    slack: m, a standard deviation of the origins besides their own.
    """
    off2, distance = squared_offsets(obs, position, of)
    return np.asarray(np.sqrt(off2 / (variance(obs, distance, 1.0, of) + slack**2)))


def information(obs: Observations, point: Floats) -> Floats:
    """The information (R, 3, 3) m^-2 of each ray about its point, (R, 3) or (3,)."""
    to = point - obs.origin
    distance = np.linalg.norm(to, axis=1)
    n = obs.direction
    along = n[:, :, None] * n[:, None, :]
    across = (np.eye(3) - along) / (obs.sigma * np.maximum(distance, MIN_DEPTH))[:, None, None] ** 2
    weight = np.where(np.isfinite(obs.range), 1 / obs.range_sigma**2, 0.0)
    return across + np.nan_to_num(weight)[:, None, None] * along


def range_costs(
    obs: Observations, distance: Floats, variance_along: Floats | float = 0.0, of: Ints | slice = slice(None)
) -> Floats:
    """What ranges add to the cost (E,) of points at `distance` (E,) m, 0 without a range; of: (E,) which rays."""
    measured = obs.range[of]
    if not np.isfinite(measured).any():
        return np.zeros(len(distance))
    with np.errstate(invalid="ignore"):
        wrong = (distance - measured) ** 2 / (obs.range_sigma[of] ** 2 + variance_along) - RANGE_GAIN
    return np.where(np.isfinite(wrong), np.minimum(wrong, RANGE_LOSS), 0.0)


def refine(obs: Observations, ray: Ints, index: Ints, start: Floats, noise: Floats) -> Floats:
    """Positions (N, 3) m of points from P pairs of a ray and its point; a ray may be in several pairs.

    Args:
        ray, index: (P,) the observation and the point of each pair.
        start: (N, 3) m; along directions that its rays do not fix, a point stays where it starts.
        noise: (N,) factor on the noise of the rays.
    """
    count = len(start)
    order = np.argsort(index, kind="stable")
    ray, index = ray[order], index[order]
    origin, direction, measured, range_sigma = obs.origin[ray], obs.direction[ray], obs.range[ray], obs.range_sigma[ray]
    along = direction[:, :, None] * direction[:, None, :]
    ranged = np.isfinite(measured)
    number = np.maximum(np.bincount(index, minlength=count), 1)
    position = start.copy()
    for _ in range(_ITERATIONS):
        to = position[index] - origin
        depth = np.einsum("ri,ri->r", to, direction)
        offset = to - depth[:, None] * direction
        distance, across = _across(to)
        spread = variance(obs, distance, noise[index], ray)
        weight = 1 / (spread + np.einsum("ri,ri->r", offset, offset) / HALF_RAY)
        beyond = np.where(ranged, measured - depth, 0.0)
        range_weight = np.where(ranged, 1 / range_sigma**2 / (1 + (beyond / range_sigma) ** 2 / _HALF_RANGE) ** 2, 0.0)
        each = weight[:, None, None] * across + range_weight[:, None, None] * along
        pull = (range_weight * beyond)[:, None] * direction - weight[:, None] * (across @ offset[:, :, None])[:, :, 0]
        total = grouped_sums(each.reshape(-1, 9), index, count).reshape(-1, 3, 3)
        total += (_DAMPING * np.trace(total, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        step = np.linalg.solve(total, grouped_sums(pull, index, count)[:, :, None])[:, :, 0]
        # under little parallax a full step may go anywhere, so a step is never longer than the point is away
        length, reach = np.linalg.norm(step, axis=1), np.bincount(index, distance, count) / number
        position = position + step * np.minimum(1.0, reach / np.maximum(length, 1e-12))[:, None]
    return position


def refine_damped(obs: Observations, number: Ints, start: Floats, damping: Floats, steps: int) -> tuple[Floats, Floats]:
    """Positions (N, 3) m of a few points, and covariances (N, 3, 3) m^2, in less time than `refine` takes.

    Args:
        obs: the rays of the first point, then those of the second, and so on.
        number: (N,) how many rays each point has, at least one.
        start: (N, 3) m.
        damping: (N, 3, 3) m^-2 information that a point is where a step finds it.
        steps: how many steps of Gauss-Newton.
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
    """The share (N,) of its rays' squared deviations that a velocity of each point explains, and how far it goes (N,) m.

    Pairs and points are as in `refine`; stamps: (P,) s of the rays.
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
    """Distances (P,) m of points `to` (P, 3) m away, and the projections (P, 3, 3) across the lines of sight to them.

    Along that line, which the ray is only nearly, no angle changes: a point that drives along with the camera gains nothing.
    """
    distance = np.maximum(np.linalg.norm(to, axis=1), 1e-6)
    toward = to / distance[:, None]
    return distance, np.eye(3) - toward[:, :, None] * toward[:, None, :]


def _standard(time: Floats, index: Ints, count: int) -> Floats:
    """Times (P,) with mean 0 and standard deviation 1 within each point."""
    number = np.maximum(np.bincount(index, minlength=count), 1)
    centred = time - (np.bincount(index, time, count) / number)[index]
    spread = np.sqrt(np.bincount(index, centred**2, count) / number)
    return np.asarray(centred / np.maximum(spread[index], 1e-9))


def grouped_sums(values: Floats, index: Ints, count: int) -> Floats:
    """Sums (count, D) of the values (P, D) of each group; index: (P,) the group of each row."""
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1).astype(np.float64)
