"""Register two maps whose frames are unknown to each other, by the relative positions of their objects.

Two objects of each map with equal labels and equal distances propose a transform. The best proposals are fitted first to the
objects around their pair, at last to the whole map. The evidence is a number of false alarms (a-contrario; Desolneux, Moisan
& Morel 2000): how many equally good proposals two maps of unrelated places would give.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import gammaln

from objslam.association.place_recognition import Constellation
from objslam.association.registration.bending import bent_matches
from objslam.association.registration.fitting import (
    Problem,
    covariances,
    fit,
    gate,
    jacobian_of,
    move,
    one_each,
    robust_step,
    transform_covariance,
)
from objslam.association.registration.proposals import around, propose
from objslam.association.registration.shapes import shape_of
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import SAME_POINT

Verdict = Literal["accepted", "ambiguous", "too little evidence"]
MIN_LOG_ODDS = 9.2
"""The least log odds against chance of an accepted registration, and the least lead over another place. A larger value
refuses more registrations. 9.2 allows one false alarm in 10,000 pairs of maps."""
_STAGES = ((32, 200), (100, 60), (1 << 30, 20))
"""The stages of the fit, with two numbers each. The first number is how many objects a proposal is fitted to. They are the
objects nearest to its pair. The second number is how many of the best proposals are fitted. Larger numbers find smaller
overlaps and take longer."""
_LIMITS = (SAME_POINT, SAME_POINT / 2)
"""The largest squared Mahalanobis distances of a match. Matches are counted once with each limit, and the count with the
most evidence is used. The first limit accepts 99 % of true matches, and the second limit accepts 87 %. With tighter limits,
simulated groups of three equal objects gave false alarms more often than the log odds say."""
_FITS = 2
"""The number of rounds of matching and fitting in each stage. A larger number takes longer."""
_SAME_SHIFT, _SAME_TURN = 0.5, 0.1
"""The largest difference of two transforms that count as the same: a shift (m, at the centre of the map) and a turn (rad).
Larger values hide repetitions."""


@dataclass(frozen=True)
class Registration:
    """The transform between the frames of two maps.

    b_T_a: (4, 4) takes points from the frame of map a to the frame of b. It turns about z only. NaN if no transform fits.
    covariance: (4, 4) the covariance of x, y, z (m) and yaw (rad) of b_T_a. matches: (P, 2) indices of one object in a and
    in b. log_odds: evidence against chance, -ln of the expected number of false alarms. second_b_T_a, second_log_odds:
    transform and log odds of the second-best place, None and -inf if only one place fits.
    """

    b_T_a: Floats
    covariance: Floats
    matches: Ints
    log_odds: float
    second_b_T_a: Floats | None
    second_log_odds: float

    @property
    def lead(self) -> float:
        """The log odds minus the log odds of the second-best place. Those of the second-best place count as at least 0."""
        return self.log_odds - max(self.second_log_odds, 0.0)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the transform. It is accepted if the log odds and the lead are both at least `MIN_LOG_ODDS`."""
        if self.log_odds < MIN_LOG_ODDS:
            return "too little evidence"
        return "accepted" if self.lead >= MIN_LOG_ODDS else "ambiguous"

    @property
    def accepted(self) -> bool:
        """Whether the transform may be used."""
        return self.verdict == "accepted"


def register_maps(
    a: Constellation, b: Constellation, shared_a: Floats | None = None, shared_b: Floats | None = None
) -> Registration:
    """Find the transform (yaw and translation) from the frame of a to the frame of b. Both maps use the same label numbers.

    shared_a, shared_b: (7, 7) the covariances of the errors that all objects of a map share, None if they are not known. The
    covariances of the objects in a and b include the shared errors. The module `shapes` explains how they are used.

    Both maps have z up. The log odds are -ln(T * P(X >= m - 2)) for T tried proposals and m matched objects. The two objects
    of the proposing pair do not count. X is the number of matches by chance, and is Poisson distributed. Its mean is a sum
    over the objects of a. The term of an object is a product: the local density of objects in b, the area of the gate, and
    the share of the objects of b that have the label and the height of this object. True matches are close together, and
    chance matches are anywhere in the gate. So several gates are tried, the best one counts, and T is the number of
    proposals times gates (Moisan & Stival 2004).
    """
    keep_a, keep_b = np.flatnonzero(np.isin(a.label, b.label)), np.flatnonzero(np.isin(b.label, a.label))
    if min(len(keep_a), len(keep_b)) < 2:
        return _nothing()
    problem = Problem(shape_of(a, keep_a, shared_a), shape_of(b, keep_b, shared_b))
    centre_a, centre_b = problem.a.centre, problem.b.centre
    first, x, tried = propose(problem)
    if len(first) == 0:
        return _nothing()
    x = _grow(problem, first, x)
    if len(x) == 0:
        return _nothing()
    every = np.broadcast_to(np.arange(len(problem.a.label)), (len(x), len(problem.a.label)))
    odds = _log_odds(problem, every, x, tried)
    best = int(np.argmax(odds))
    other = np.where(_differ(x, x[best]), odds, -np.inf)
    second = int(np.argmax(other)) if np.isfinite(other).any() else None
    fitted, covariance, matches = _finish(problem, x[best])

    def whole(pose: Floats) -> Floats:
        transform = lift_se2(pose[[0, 1, 3]])
        transform[:3, 3] = pose[:3] + centre_b - transform[:3, :3] @ centre_a
        return transform

    b_T_a = whole(fitted)
    lever = np.eye(4)  # Takes the covariance at the centre of a to the origin of a.
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


def _grow(problem: Problem, first: Ints, x: Floats) -> Floats:
    """Fit the best transforms to the objects around their pair, then to more, then to all (`_STAGES`). Return the remaining
    transforms (H, 4). first: the first object of a in the pair of each transform."""
    for size, entering in _STAGES:
        first, x = first[:entering], x[:entering]
        index = around(problem.a, first, size)
        hessian = np.full((len(x), 4, 4), np.nan)
        for _ in range(_FITS):
            x, hessian = fit(problem, index, x, hessian)
        fitted = np.isfinite(hessian).all(axis=(1, 2))
        first, x, index = first[fitted], x[fitted], index[fitted]
        best = np.argsort(-_log_odds(problem, index, x, 1), kind="stable")
        kept: list[int] = []
        for h in best.tolist():
            if not kept or _differ(x[kept], x[h]).all():
                kept.append(h)
        first, x = first[kept], x[kept]
    return x


def _differ(x: Floats, other: Floats) -> Bools:
    """Return which transforms (H, 4) are at another place than the transform `other` (4,)."""
    turn = (x[:, 3] - other[3] + np.pi) % (2 * np.pi) - np.pi
    return np.asarray((np.hypot(*(x[:, :2] - other[:2]).T) > _SAME_SHIFT) | (np.abs(turn) > _SAME_TURN))


def _log_odds(problem: Problem, index: Ints, x: Floats, tried: int) -> Floats:
    """Return the log odds against chance (H,) of transforms (H, 4), by the formula of `register_maps`.

    A bound for the tail of the Poisson distribution is its first term and a geometric series: with mean u, P(X >= n) is at
    most exp(n ln u - u - ln n!) / (1 - u / (n + 1)).
    """
    moved = move(x, problem.a.position[index])
    partner, miss, covariance, _, _ = gate(problem, index, x, np.full((len(x), 4, 4), np.nan))
    squared = (miss * np.linalg.solve(covariance, miss[..., None])[..., 0]).sum(axis=-1)
    number = np.array([np.maximum(one_each(partner, squared <= limit).sum(axis=1) - 2, 0) for limit in _LIMITS])
    mean = np.maximum(problem.chance(moved, index, covariance, _LIMITS).sum(axis=2), 1e-12)
    beyond = number > mean
    rest = np.where(beyond, mean / (number + 1), 0.0)
    tail = number * np.log(mean) - mean - gammaln(number + 1) - np.log1p(-rest)
    return np.asarray(-np.where(beyond, np.minimum(tail, 0.0), 0.0).min(axis=0) - np.log(tried * len(_LIMITS)))


def _finish(problem: Problem, x: Floats) -> tuple[Floats, Floats, Ints]:
    """Match all objects one-to-one near a transform (4,), in maps that bend, and fit the transform to the matches.

    Return the transform, its covariance (4, 4), and the matches (P, 2).
    """
    matches = bent_matches(problem, x)
    a, b = matches.T
    if len(a) < 2:
        return x, np.full((4, 4), np.nan), matches
    for _ in range(_FITS):
        moved = move(x[None], problem.a.position[None])[0]
        fitted, _ = robust_step(
            x[None],
            (problem.b.position[b] - moved[a])[None],
            covariances(problem, x[None], a[None], b[None]),
            jacobian_of(x[None], moved[a][None]),
            np.ones((1, len(a)), dtype=bool),
        )
        x = fitted[0]
    return x, transform_covariance(problem, x, a, b), matches
