"""Register two maps whose frames are unknown to each other, by how their objects lie to each other.

Pairs of objects with equal labels and equal distances propose transforms. The best proposals grow from the neighbourhood of
their pair to the whole map. The evidence is a number of false alarms (a-contrario; Desolneux, Moisan & Morel 2000): how many
proposals as good as this one two maps of unrelated places would give.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.special import gammaln

from objslam.association.place_recognition import Constellation
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import HUBER_K, SAME_POINT

Verdict = Literal["accepted", "ambiguous", "too little evidence"]

MIN_LOG_ODDS = 9.2
"""The least log odds against chance of an accepted registration, and its least lead over another place. A larger value
refuses more. 9.2 allows one false alarm in 10,000 pairs of maps."""
_PAIRS = 6000
"""The most ordered pairs of one map that propose transforms, except that each object has at least `_MIN_PARTNERS`. A larger
number finds smaller overlaps and takes longer. Chosen by tools/bench_registration.py."""
_MIN_PARTNERS = 6
"""The least number of partners of an object in the pairs. A larger number takes longer on large maps."""
_MIN_BASE = 6.0
"""The least distance of a pair's two objects, in standard deviations of their difference. A larger value gives better
headings and fewer pairs. At 6, the heading of a pair has a standard deviation below 1/6 rad in each map."""
_GATE = 3.0
"""The largest difference of two pairs' lengths, in standard deviations. A larger value proposes more wrong transforms."""
_MAX_PROPOSALS = 60_000
"""The most proposals that are compared by the neighbours of their pair. A larger number takes longer."""
_NEIGHBOURS = 12
"""The number of neighbours that compare a proposal. A larger number ranks better and takes longer."""
_AT_ONCE = 1 << 20
"""The most differences of neighbours computed together. A larger number needs more memory."""
_STAGES = ((32, 400), (128, 120), (1 << 30, 40))
"""For each stage of growth, how many objects around its pair a proposal is fitted to, and how many proposals enter. Larger
numbers find smaller overlaps and take longer."""
_FITS = 3
"""The number of rounds of matching and fitting in each stage. The fits change little after three."""
_DENSITY_NEIGHBOURS = 8
"""The number of neighbours that measure the local density of objects. A larger number smooths the density more."""
_SAME_SHIFT, _SAME_TURN = 0.5, 0.1
"""Two transforms nearer than this (m at the middle of the map, rad) are one place. Larger values hide a near repetition."""
_FLOOR = 0.01
"""The least standard deviation (m) of a position. It lets maps without noise be registered."""


@dataclass(frozen=True)
class Registration:
    """How one map lies in the frame of another.

    b_T_a: (4, 4) takes points of the map a to the frame of b; it turns about z only. NaN if no transform fits at all.
    covariance: (4, 4) of the x, y, z (m) and yaw (rad) of b_T_a. matches: (P, 2) indices of one object in a and in b.
    log_odds: evidence against chance, -ln of the expected number of false alarms. second_b_T_a, second_log_odds: the same of
    the best other place, None and -inf if there is none.
    """

    b_T_a: Floats
    covariance: Floats
    matches: Ints
    log_odds: float
    second_b_T_a: Floats | None
    second_log_odds: float

    @property
    def lead(self) -> float:
        """How much the log odds exceed those of the best other place, or 0 where that place has none."""
        return self.log_odds - max(self.second_log_odds, 0.0)

    @property
    def verdict(self) -> Verdict:
        """Whether the evidence carries the transform, and whether it carries another place as well."""
        if self.log_odds < MIN_LOG_ODDS:
            return "too little evidence"
        return "accepted" if self.lead >= MIN_LOG_ODDS else "ambiguous"

    @property
    def accepted(self) -> bool:
        """Whether the transform may be used."""
        return self.verdict == "accepted"


def register_maps(a: Constellation, b: Constellation) -> Registration:
    """Find the transform (yaw and translation) from the frame of a to that of b. Labels are numbers that both maps share.

    Both maps have z up. The log odds are -ln(T * P(X >= m - 2)): T proposals were tried, m objects match, and X is Poisson
    with the mean of the chance matches. The chance that an object of a has a match is the local density of objects in b,
    times the area of the gate, times the share of the objects of b that have its label and its height. The two objects of
    the proposing pair do not count.
    """
    keep_a, keep_b = np.flatnonzero(np.isin(a.label, b.label)), np.flatnonzero(np.isin(b.label, a.label))
    if min(len(keep_a), len(keep_b)) < 2:
        return _nothing()
    centre_a, centre_b = a.position[keep_a].mean(axis=0), b.position[keep_b].mean(axis=0)
    problem = _Problem(_part(a, keep_a, centre_a), _part(b, keep_b, centre_b))
    first, x, tried = _propose(problem)
    if len(first) == 0:
        return _nothing()
    x = _grow(problem, first, x)
    if len(x) == 0:
        return _nothing()
    odds = _log_odds(problem, _everything(problem, x), x, tried)
    best = int(np.argmax(odds))
    other = np.where(_differ(x, x[best]), odds, -np.inf)
    second = int(np.argmax(other)) if np.isfinite(other).any() else None
    fitted, covariance, matches = _finish(problem, x[best])

    def whole(pose: Floats) -> Floats:
        transform = lift_se2(pose[[0, 1, 3]])
        transform[:3, 3] = pose[:3] + centre_b - transform[:3, :3] @ centre_a
        return transform

    b_T_a = whole(fitted)
    lever = np.eye(4)  # The translation of b_T_a is that of the centre, less the turned centre.
    turned = b_T_a[:3, :3] @ centre_a
    lever[0, 3], lever[1, 3] = turned[1], -turned[0]
    return Registration(
        b_T_a,
        lever @ covariance @ lever.T,
        np.column_stack([keep_a[matches[:, 0]], keep_b[matches[:, 1]]]),
        float(odds[best]),
        None if second is None else whole(x[second]),
        -np.inf if second is None else float(other[second]),
    )


def _nothing() -> Registration:
    unknown = np.full((4, 4), np.nan)
    return Registration(unknown, unknown, np.zeros((0, 2), dtype=np.int64), -np.inf, None, -np.inf)


def _part(whole: Constellation, keep: Ints, centre: Floats) -> Constellation:
    return Constellation(
        whole.position[keep] - centre, whole.covariance[keep] + _FLOOR**2 * np.eye(3), whole.label[keep]
    )


class _Problem:
    """Both maps about their middles, with what is computed once of them.

    spread_a, spread_b: (N,) and (M,) horizontal variance of a position, m^2. apart: m, more than any two objects are apart.
    """

    def __init__(self, a: Constellation, b: Constellation) -> None:
        self.a, self.b = a, b
        self.spread_a, self.spread_b = (np.trace(m.covariance[:, :2, :2], axis1=1, axis2=2) / 2 for m in (a, b))
        self.apart = 4 * max(float(np.abs(m.position).max()) for m in (a, b)) + 1.0
        self._labelled = KDTree(np.column_stack([b.position, b.label * self.apart]))
        self._level = KDTree(b.position[:, :2])
        order = np.lexsort((b.position[:, 2], b.label))
        self._heights = b.position[order, 2] + b.label[order] * 4 * self.apart

    def nearest(self, moved: Floats, index: Ints) -> Ints:
        """Return for points (H, P, 3) of the objects `index` (H, P) of a the nearest object of b with an equal label."""
        at = np.concatenate([moved, self.a.label[index][..., None] * self.apart], axis=-1)
        return np.asarray(self._labelled.query(at.reshape(-1, 4))[1]).reshape(index.shape)

    def chance(self, moved: Floats, index: Ints, covariance: Floats) -> Floats:
        """Return the probability (H, P) that an object of a, moved to (H, P, 3), has a match in b by chance."""
        k = min(_DENSITY_NEIGHBOURS, len(self.b.label))
        radius = self._level.query(moved[..., :2].reshape(-1, 2), k=[k])[0].reshape(index.shape)
        area = np.pi * SAME_POINT * np.sqrt(np.linalg.det(covariance[..., :2, :2]))
        gate = np.minimum(np.sqrt(SAME_POINT * covariance[..., 2, 2]), self.apart)
        height = np.clip(moved[..., 2], -self.apart, self.apart) + self.a.label[index] * 4 * self.apart
        like = np.searchsorted(self._heights, height + gate) - np.searchsorted(self._heights, height - gate)
        mean = k / (np.pi * radius**2 + area) * area * np.maximum(like, 1) / len(self.b.label)
        return -np.expm1(-mean)


def _pairs(m: Constellation, spread: Floats) -> tuple[Ints, Ints]:
    """Return the ordered pairs (P,), (P,) of each object and its nearest partners that give a heading."""
    count = len(m.label)
    partners = min(count - 1, max(_MIN_PARTNERS, _PAIRS // count))
    distance, index = KDTree(m.position[:, :2]).query(m.position[:, :2], k=min(count, 3 * partners + 1))
    far = distance > _MIN_BASE * np.sqrt(spread[:, None] + spread[index])
    i, column = np.nonzero(far & (np.cumsum(far, axis=1) <= partners))
    return i, index[i, column]


def _propose(problem: _Problem) -> tuple[Ints, Floats, int]:
    """Return the proposals: the first object (H,) of its pair in a, the transform (H, 4), and how many were tried in all.

    A transform is where the middle of a lies in b: x, y, z (m) and yaw (rad). If there are too many proposals, those of the
    pairs with the fewest like pairs remain, because they are the most distinctive.
    """
    a, b = problem.a, problem.b
    (i, j), (k, l) = _pairs(a, problem.spread_a), _pairs(b, problem.spread_b)
    base_a, base_b = a.position[j] - a.position[i], b.position[l] - b.position[k]
    long_a, long_b = (np.hypot(base[:, 0], base[:, 1]) for base in (base_a, base_b))
    var_a, var_b = problem.spread_a[i] + problem.spread_a[j], problem.spread_b[k] + problem.spread_b[l]
    labels = int(a.label.max()) + 1
    key = (b.label[k] * labels + b.label[l]) * 2 * problem.apart + long_b
    order = np.argsort(key, kind="stable")
    middle = (a.label[i] * labels + a.label[j]) * 2 * problem.apart + long_a
    reach = np.minimum(_GATE * np.sqrt(var_a + var_b.max(initial=0.0)), problem.apart / 4)
    begin, end = np.searchsorted(key[order], middle - reach), np.searchsorted(key[order], middle + reach, side="right")
    number = end - begin
    rare = np.argsort(number, kind="stable")
    rare = rare[np.cumsum(number[rare]) <= _MAX_PROPOSALS]
    p = np.repeat(rare, number[rare])
    step = np.arange(len(p)) - np.repeat(np.cumsum(number[rare]) - number[rare], number[rare])
    q = order[begin[p] + step]
    tall_a, tall_b = (m.covariance[u, 2, 2] + m.covariance[v, 2, 2] for m, u, v in ((a, i, j), (b, k, l)))
    fits = np.abs(long_a[p] - long_b[q]) <= _GATE * np.sqrt(var_a[p] + var_b[q])
    fits &= np.abs(base_a[p, 2] - base_b[q, 2]) <= _GATE * np.sqrt(tall_a[p] + tall_b[q])
    share = fits.mean() if len(fits) else 0.0
    p, q = p[fits], q[fits]
    yaw = np.arctan2(base_b[q, 1], base_b[q, 0]) - np.arctan2(base_a[p, 1], base_a[p, 0])
    x = np.column_stack([np.zeros((len(p), 3)), yaw])
    ends_a, ends_b = a.position[i[p]] + a.position[j[p]], b.position[k[q]] + b.position[l[q]]
    x[:, :3] = (ends_b - _move(x, ends_a[:, None])[:, 0]) / 2
    support = _support(problem, i[p], k[q], yaw, (var_a[p] + var_b[q]) / long_a[p] ** 2)
    best = np.argsort(-support, kind="stable")
    # Of the proposals of one place, in cells of a metre and of 0.2 rad, only the best remains.
    cell = np.round(np.column_stack([x[:, :2], np.mod(yaw, 2 * np.pi) / 0.2]))[best]
    best = best[np.sort(np.unique(cell, axis=0, return_index=True)[1])][: _STAGES[0][1]]
    return i[p[best]], x[best], max(1, round(float(number.sum() * share) / 2))  # Each pair proposes in both orders.


def _support(problem: _Problem, i: Ints, k: Ints, yaw: Floats, turn_variance: Floats) -> Floats:
    """Return how many neighbours (H,) of the object i (H,) of a land on a neighbour of the object k (H,) of b."""
    (near_a, offset_a), (near_b, offset_b) = (_offsets(m) for m in (problem.a, problem.b))
    support = np.zeros(len(i))
    spread = float(np.median(problem.spread_b))
    size = max(1, _AT_ONCE // (near_a.shape[1] * near_b.shape[1]))
    for begin in range(0, len(i), size):
        h = slice(begin, begin + size)
        a, b = near_a[i[h]], near_b[k[h]]
        turned = offset_a[i[h]] * np.exp(1j * yaw[h])[:, None]
        own = problem.spread_a[i[h]] + problem.spread_b[k[h]]
        variance = problem.spread_a[a] + spread + own[:, None] + np.abs(turned) ** 2 * turn_variance[h, None]
        miss = turned[:, :, None] - offset_b[k[h]][:, None, :]
        close = miss.real**2 + miss.imag**2 <= _GATE**2 * variance[:, :, None]
        close &= problem.a.label[a][:, :, None] == problem.b.label[b][:, None, :]
        rise = problem.a.position[a, 2] - problem.a.position[i[h], 2][:, None]
        rise_b = problem.b.position[b, 2] - problem.b.position[k[h], 2][:, None]
        tall = problem.a.covariance[a, 2, 2] + 2 * np.median(problem.b.covariance[:, 2, 2])
        tall += problem.a.covariance[i[h], 2, 2][:, None]
        close &= (rise[:, :, None] - rise_b[:, None, :]) ** 2 <= _GATE**2 * tall[:, :, None]
        support[h] = close.any(axis=2).sum(axis=1)
    return support


def _offsets(m: Constellation) -> tuple[Ints, np.ndarray]:
    """Return the neighbours (N, K) of each object and their offsets (N, K), as complex numbers."""
    plane = m.position[:, 0] + 1j * m.position[:, 1]
    near = _around(m, np.arange(len(plane)), _NEIGHBOURS + 1)[:, 1:]
    return near, plane[near] - plane[:, None]


def _around(m: Constellation, index: Ints, size: int) -> Ints:
    """Return for each object `index` (H,) the `size` objects nearest to it, itself first."""
    at = m.position[:, :2]
    return np.asarray(KDTree(at).query(at[index], k=np.arange(1, min(size, len(at)) + 1))[1])


def _move(x: Floats, points: Floats) -> Floats:
    """Return points (..., P, 3) under transforms (..., 4)."""
    cos, sin = np.cos(x[..., 3, None]), np.sin(x[..., 3, None])
    turned = (cos * points[..., 0] - sin * points[..., 1], sin * points[..., 0] + cos * points[..., 1])
    return np.stack([*turned, np.broadcast_to(points[..., 2], turned[0].shape)], axis=-1) + x[..., None, :3]


def _grow(problem: _Problem, first: Ints, x: Floats) -> Floats:
    """Return the best transforms (H, 4), each fitted to the objects around its pair, then farther, then to all."""
    for size, entering in _STAGES:
        first, x = first[:entering], x[:entering]
        index = _around(problem.a, first, size)
        hessian = np.full((len(x), 4, 4), np.nan)
        for _ in range(_FITS):
            x, hessian = _fit(problem, index, x, hessian)
        fitted = np.isfinite(hessian).all(axis=(1, 2))
        first, x, index = first[fitted], x[fitted], index[fitted]
        best = np.argsort(-_log_odds(problem, index, x, 1), kind="stable")
        kept: list[int] = []
        for h in best.tolist():
            if not kept or _differ(x[kept], x[h]).all():
                kept.append(h)
        first, x = first[kept], x[kept]
    return x


def _covariances(problem: _Problem, x: Floats, a: Ints, b: Ints) -> Floats:
    """Return the covariances (H, P, 3, 3) of the differences of objects `a` under transforms x (H, 4) from objects `b`."""
    rotation = lift_se2(np.stack([x[:, 0], x[:, 1], x[:, 3]], axis=1))[:, None, :3, :3]
    return rotation @ problem.a.covariance[a] @ np.swapaxes(rotation, -1, -2) + problem.b.covariance[b]


def _jacobian(x: Floats, moved: Floats) -> Floats:
    """Return the Jacobians (H, P, 3, 4) of moved points (H, P, 3) by x, y, z and yaw."""
    jacobian = np.zeros((*moved.shape, 4))
    jacobian[..., [0, 1, 2], [0, 1, 2]] = 1.0
    jacobian[..., 0, 3] = -(moved[..., 1] - x[:, None, 1])
    jacobian[..., 1, 3] = moved[..., 0] - x[:, None, 0]
    return jacobian


def _gate(problem: _Problem, index: Ints, x: Floats, hessian: Floats) -> tuple[Ints, Floats, Floats, Floats, Bools]:
    """Return for objects of a (H, P) their nearest objects of b, the misses, covariances, Jacobians, and which match.

    hessian: (H, 4, 4) the information of the transforms, NaN before the first fit. Its inverse widens the gates.
    """
    moved = _move(x, problem.a.position[index])
    partner = problem.nearest(moved, index)
    miss = problem.b.position[partner] - moved
    covariance = _covariances(problem, x, index, partner)
    jacobian = _jacobian(x, moved)
    known = np.isfinite(hessian).all(axis=(1, 2))
    doubt = np.zeros((len(x), 4, 4))
    doubt[known] = np.linalg.inv(hessian[known])
    total = covariance + jacobian @ doubt[:, None] @ np.swapaxes(jacobian, -1, -2)
    squared = (miss * np.linalg.solve(total, miss[..., None])[..., 0]).sum(axis=-1)
    gate = np.where(known, SAME_POINT, 2 * SAME_POINT)[:, None]  # The heading of a pair alone is coarse.
    return partner, miss, covariance, jacobian, squared <= gate


def _fit(problem: _Problem, index: Ints, x: Floats, hessian: Floats) -> tuple[Floats, Floats]:
    """Return transforms (H, 4) after one robust Gauss-Newton step on the matches of objects (H, P), and their information.

    A transform with fewer than two matches stays, and its information is NaN.
    """
    _, miss, covariance, jacobian, good = _gate(problem, index, x, hessian)
    return _step(x, miss, covariance, jacobian, good)


def _step(x: Floats, miss: Floats, covariance: Floats, jacobian: Floats, good: Bools) -> tuple[Floats, Floats]:
    """Return transforms (H, 4) after one Gauss-Newton step with Huber's weights, and their information (H, 4, 4)."""
    information = np.linalg.inv(covariance)
    deviation = np.sqrt(np.einsum("hpi,hpij,hpj->hp", miss, information, miss))
    weight = good * np.minimum(1.0, HUBER_K / np.maximum(deviation, 1e-12))
    weighted = np.swapaxes(jacobian, -1, -2) @ (information * weight[..., None, None])
    hessian = (weighted @ jacobian).sum(axis=1)
    gradient = (weighted @ miss[..., None])[..., 0].sum(axis=1)
    fixed = (good.sum(axis=1) >= 2) & (np.linalg.cond(hessian) < 1e12)
    hessian[~fixed] = np.eye(4)
    step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
    hessian[~fixed] = np.nan
    return np.where(fixed[:, None], x + step, x), hessian


def _one_each(partner: Ints, good: Bools) -> Bools:
    """Return which matches (H, P) remain if an object of b counts once in each row."""
    marked = np.where(good, partner, -1 - np.arange(partner.shape[1]))
    order = np.argsort(marked, axis=1, kind="stable")
    ordered = np.take_along_axis(marked, order, axis=1)
    first = np.ones(good.shape, dtype=bool)
    first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
    once = np.zeros(good.shape, dtype=bool)
    np.put_along_axis(once, order, first, axis=1)
    return once & good


def _everything(problem: _Problem, x: Floats) -> Ints:
    """Return the indices (H, N) of all objects of a for each transform."""
    return np.broadcast_to(np.arange(len(problem.a.label)), (len(x), len(problem.a.label)))


def _differ(x: Floats, other: Floats) -> Bools:
    """Return which transforms (H, 4) are another place than one transform (4,)."""
    turn = (x[:, 3] - other[3] + np.pi) % (2 * np.pi) - np.pi
    return np.asarray((np.hypot(*(x[:, :2] - other[:2]).T) > _SAME_SHIFT) | (np.abs(turn) > _SAME_TURN))


def _log_odds(problem: _Problem, index: Ints, x: Floats, tried: int) -> Floats:
    """Return the log odds against chance (H,) of transforms (H, 4), by the formula of `register_maps`.

    The tail of the Poisson distribution is bounded by its first term and a geometric series: with mean u, P(X >= n) is at
    most exp(n ln u - u - ln n!) / (1 - u / (n + 1)).
    """
    moved = _move(x, problem.a.position[index])
    partner, miss, covariance, _, _ = _gate(problem, index, x, np.full((len(x), 4, 4), np.nan))
    squared = (miss * np.linalg.solve(covariance, miss[..., None])[..., 0]).sum(axis=-1)
    number = np.maximum(_one_each(partner, squared <= SAME_POINT).sum(axis=1) - 2, 0)
    mean = np.maximum(problem.chance(moved, index, covariance).sum(axis=1), 1e-12)
    beyond = number > mean
    rest = np.where(beyond, mean / (number + 1), 0.0)
    tail = number * np.log(mean) - mean - gammaln(number + 1) - np.log1p(-rest)
    return np.asarray(-np.where(beyond, np.minimum(tail, 0.0), 0.0) - np.log(tried))


def _finish(problem: _Problem, x: Floats) -> tuple[Floats, Floats, Ints]:
    """Match all objects one-to-one under a transform (4,) and fit it to the matches.

    Returns the transform, its covariance (4, 4), and the matches (P, 2).
    """
    a = b = np.zeros(0, dtype=np.int64)
    hessian = np.eye(4)[None]
    for _ in range(_FITS):
        moved = _move(x[None], problem.a.position[None])[0]
        near = KDTree(moved).sparse_distance_matrix(KDTree(problem.b.position), _reach(problem), output_type="coo_matrix")
        one, two = (np.asarray(rows, dtype=np.int64) for rows in (near.row, near.col))
        equal = problem.a.label[one] == problem.b.label[two]
        one, two = one[equal], two[equal]
        miss = problem.b.position[two] - moved[one]
        squared = (miss * np.linalg.solve(_covariances(problem, x[None], one[None], two[None])[0], miss[..., None])[..., 0]).sum(axis=1)
        good = squared <= SAME_POINT
        gain = np.zeros((len(moved), len(problem.b.label)))
        gain[one[good], two[good]] = 2 * SAME_POINT - squared[good]
        a, b = linear_sum_assignment(-gain)
        matched = gain[a, b] > 0
        a, b = a[matched], b[matched]
        if len(a) < 2:
            break
        fitted, hessian = _step(
            x[None],
            (problem.b.position[b] - moved[a])[None],
            _covariances(problem, x[None], a[None], b[None]),
            _jacobian(x[None], moved[a][None]),
            np.ones((1, len(a)), dtype=bool),
        )
        x = fitted[0]
    return x, np.linalg.inv(hessian[0]), np.column_stack([a, b])


def _reach(problem: _Problem) -> float:
    """Return the largest distance (m) of two objects that may match."""
    widest = sum(float(np.linalg.eigvalsh(m.covariance)[:, -1].max()) for m in (problem.a, problem.b))
    return float(np.sqrt(SAME_POINT * widest))
