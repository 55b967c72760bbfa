"""Search for objects with few rays: points on which free rays of one label agree more closely than by chance.

The search for well seen objects counts the rays at a point. This search adds up their log odds against chance, so two rays,
or one ray with a range, can be enough where strays are rare.
"""

from dataclasses import dataclass

import numpy as np

from objslam.association.few_rays.chance import Strays, log_volume, ray_odds
from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import grouped_sums

_MOST_PAIRS = 4096
"""The most pairs of rays whose odds are computed. The pairs that fit best are taken. A larger number finds more in dense
clutter."""
_MOST_POINTS = 512
"""The most points that are compared with all rays. A larger number finds more in dense clutter, and costs time."""
_MORE_RAYS = 3.0
"""The log odds that further rays may add to the log odds of a pair. A larger value tries more points."""
_REFINEMENTS = 2
"""The number of times that each point moves to the best fit of its rays. A larger number costs time."""
_DAMPING = 1e-6
"""The share of the information added in all directions. Unobserved directions then stay unchanged. A larger share slows the
refinement down."""


@dataclass(frozen=True)
class SparseSearch:
    """The settings of a search. strays: the density of stray rays. number: how many stray boxes the label has in the log.
    gate: largest squared deviation of a pair. parallax: least angle (rad) of a pair. least: the least log odds of a
    point."""

    strays: Strays
    number: float
    gate: float
    parallax: float
    least: float


def discover_sparse(obs: Observations, search: SparseSearch) -> Floats:
    """Return the points (N, 3) m on which rays of one label agree better than by chance. The surest point comes first.

    A point takes the rays with positive odds, at most one in each frame. If a surer point takes one of its rays, the point
    is judged again without this ray.
    """
    points, free, found = _propose(obs, search), np.ones(len(obs), dtype=bool), list[Floats]()
    while len(points):
        points, odds, taken = _judge(obs, points, free, search)
        some = np.argsort(-odds, kind="stable")
        some = some[odds[some] >= search.least]
        for i in some.tolist():
            if free[taken[i]].all():
                found.append(points[i])
                free &= ~taken[i]
        points = points[some]
    return np.array(found).reshape(-1, 3)


def _propose(obs: Observations, search: SparseSearch) -> Floats:
    """Return the ends (H, 3) of ranged rays, and the points where two rays of different frames meet, the likeliest first."""
    ranged = np.flatnonzero(np.isfinite(obs.range))
    ends = obs.origin[ranged] + obs.range[ranged, None] * obs.direction[ranged]
    first, second, middle = _meetings(obs, search)
    points = np.concatenate([ends, middle])
    odds = np.concatenate([_odds(obs, search, ends, ranged[None]), _odds(obs, search, middle, np.stack([first, second]))])
    some = np.argsort(-odds, kind="stable")[:_MOST_POINTS]
    return np.asarray(points[some[odds[some] >= search.least - _MORE_RAYS]])


def _meetings(obs: Observations, search: SparseSearch) -> tuple[Ints, Ints, Floats]:
    """Return the two rays of each pair that meets, and the points (P, 3) m where they meet."""
    first, second = np.triu_indices(len(obs), 1)
    depth1, depth2, middle, apart2, sin2 = closest_approach(obs, first, second)
    spread = (obs.sigma[first] * depth1) ** 2 + (obs.sigma[second] * depth2) ** 2 + 2 * obs.position_sigma**2
    off = apart2 / np.maximum(spread, 1e-12)
    for ray, depth in ((first, depth1), (second, depth2)):
        off = off + np.nan_to_num(((depth - obs.range[ray]) / obs.range_sigma[ray]) ** 2)
    meet = (depth1 > MIN_DEPTH) & (depth2 > MIN_DEPTH) & (off <= 2 * search.gate)
    meet &= (obs.frame[first] != obs.frame[second]) & (sin2 >= max(np.sin(search.parallax), 1e-3) ** 2)
    pairs = np.flatnonzero(meet)
    pairs = pairs[np.argsort(off[pairs], kind="stable")[:_MOST_PAIRS]]
    return first[pairs], second[pairs], middle[pairs]


def _odds(obs: Observations, search: SparseSearch, points: Floats, rays: Ints) -> Floats:
    """Return the log odds (H,) of points (H, 3) m. rays: (S, H) the S rays from which each point was made."""
    total, objects, away = np.zeros((3, len(points)))
    information = np.zeros((len(points), 3, 3))
    for ray in rays:
        mine = obs.take(ray)
        to = points - mine.origin
        depth, distance2 = np.einsum("hi,hi->h", to, mine.direction), np.einsum("hi,hi->h", to, to)
        distance = np.sqrt(np.maximum(distance2, MIN_DEPTH**2))
        off2 = np.maximum(distance2 - depth**2, 0.0)
        odds, density = ray_odds(mine, search.strays.take(ray), search.number, off2, distance, 1.0, search.gate)
        total += odds
        away += distance / len(rays)
        objects += density * search.strays.along(distance, mine.label) / len(rays)
        n = mine.direction
        along = n[:, :, None] * n[:, None, :]
        information += (np.eye(3) - along) / ((mine.sigma * distance) ** 2 + obs.position_sigma**2)[:, None, None]
        information += np.nan_to_num(1 / mine.range_sigma**2)[:, None, None] * along
    return np.asarray(total + log_volume(information, away) + np.log(np.maximum(objects, 1e-300)))


def _judge(obs: Observations, points: Floats, free: Bools, search: SparseSearch) -> tuple[Floats, Floats, Bools]:
    """Refine points (H, 3), and return them with their log odds (H,) and the mask (H, R) of their rays. free: (R,) the rays
    that no point has taken yet. Only these are compared with the points."""
    left, every = np.flatnonzero(free), len(obs)
    if not len(left):
        return points, np.full(len(points), -np.inf), np.zeros((len(points), every), dtype=bool)
    obs, strays = obs.take(left), search.strays.take(left)
    n, known = obs.direction, np.isfinite(obs.range)
    along = n[:, :, None] * n[:, None, :]
    across = np.eye(3) - along
    centre = obs.origin.mean(axis=0)
    origin, points = obs.origin - centre, points - centre
    foot, ahead = (across @ origin[:, :, None])[:, :, 0], (n * origin).sum(axis=1)
    end = n * (ahead + np.where(known, obs.range, 0.0))[:, None]
    precision = np.where(known, 1 / obs.range_sigma**2, 0.0)
    starts = np.diff(obs.frame, prepend=-1) != 0
    begin, of_frame = np.flatnonzero(starts), np.cumsum(starts) - 1
    weight, ranged = np.zeros((2, len(points), len(left)))
    for step in range(_REFINEMENTS + 1):
        depth = points @ n.T - ahead
        distance2 = (points**2).sum(axis=1)[:, None] + (origin**2).sum(axis=1) - 2 * points @ origin.T
        np.maximum(distance2, MIN_DEPTH**2, out=distance2)
        distance = np.sqrt(distance2)
        off2 = distance2 - depth**2
        np.maximum(off2, 0.0, out=off2)
        odds, density = ray_odds(obs, strays, search.number, off2, distance, 1.0, search.gate)
        odds[depth <= MIN_DEPTH] = -np.inf
        # Most rays have no positive odds at a point. Everything below is computed only for rays with positive odds.
        point, ray = np.nonzero(odds > 0)
        best = np.maximum.reduceat(odds, begin, axis=1)[point, of_frame[ray]]
        point, ray = (some[odds[point, ray] == best] for some in (point, ray))
        away = distance[point, ray]
        weight[:], ranged[:] = 0.0, 0.0
        weight[point, ray] = 1 / ((obs.sigma[ray] * away) ** 2 + obs.position_sigma**2)
        ranged[point, ray] = precision[ray]
        information = (weight @ across.reshape(-1, 9) + ranged @ along.reshape(-1, 9)).reshape(-1, 3, 3)
        if step == _REFINEMENTS:
            break
        damping = (_DAMPING * np.trace(information, axis1=1, axis2=2) + 1e-9)[:, None]
        right = weight @ foot + ranged @ end + damping * points
        points = np.linalg.solve(information + damping[:, :, None] * np.eye(3), right[:, :, None])[:, :, 0]
    count = np.bincount(point, minlength=len(points))
    dense = density[point, ray] * strays.along(away, obs.label[ray])
    total, objects, reach = grouped_sums(np.stack([odds[point, ray], dense, away], axis=1), point, len(points)).T
    number = np.maximum(count, 1)
    total = total + log_volume(information, reach / number) + np.log(np.maximum(objects / number, 1e-300))
    taken = np.zeros((len(points), every), dtype=bool)
    taken[point, left[ray]] = True
    return points + centre, np.where(count > 0, total, -np.inf), taken
