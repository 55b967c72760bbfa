"""Assign measurements to landmarks whose errors are correlated (joint compatibility; Neira and Tardos, JCBB, 2001).

A pairing is a measurement and a landmark that it may show. A hypothesis is a set of pairings. One error of the pose shifts
all measurements of a frame, so each accepted pairing predicts the others. A hypothesis begins with one pairing, and the best
further pairing is added in each step. Its odds compare it with "all measurements are of new things".
"""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

_SEEDS = 6
"""The number of hypotheses that are grown, each from another pairing. A larger number is slower, and finds rarer
hypotheses."""


@dataclass(frozen=True)
class Pairings:
    """P possible pairings of a measurement and a landmark, each with D residuals.

    row, column: (P,) the measurement and the landmark. residual: (P, D). covariance: (P, D, P, D) of all residuals, with the
    correlations between pairings. rarity: (P,) minus the log density of the residuals of a new thing. gate: the largest
    squared deviation of a pairing.
    """

    row: Ints
    column: Ints
    residual: Floats
    covariance: Floats
    rarity: Floats
    gate: float


@dataclass(frozen=True)
class JointAssignment:
    """The best hypothesis.

    chosen: (n,) the indices of its pairings. odds: its log odds against the hypothesis that all measurements are of new
    things. The best hypothesis without a pairing is its alternative. margin: (n,) by how much `odds` exceeds the log odds of
    the alternative to each pairing. rival: (n,) whether this alternative pairs the same measurement with another landmark.
    """

    chosen: Ints
    margin: Floats
    rival: Bools
    odds: float


def assign_jointly(pairings: Pairings) -> JointAssignment:
    """Return the hypothesis with the highest odds. A measurement and a landmark are in at most one of its pairings."""
    none = JointAssignment(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=bool), 0.0)
    if len(pairings.row) == 0:
        return none
    odds = _odds(pairings, pairings.residual, _blocks(pairings.covariance))
    allowed = np.isfinite(odds)
    if _is_unambiguous(pairings, allowed):
        whole = _whole(pairings, np.flatnonzero(allowed))
        if whole is not None:
            return whole
    chosen, best = _best(pairings, odds, allowed)
    if len(chosen) == 0:
        return none
    margin, rival = np.zeros(len(chosen)), np.zeros(len(chosen), dtype=bool)
    for i, pairing in enumerate(chosen.tolist()):
        without = allowed.copy()
        without[pairing] = False
        others, second = _best(pairings, odds, without)
        margin[i], rival[i] = best - second, pairings.row[pairing] in pairings.row[others]
    return JointAssignment(chosen, margin, rival, best)


def _is_unambiguous(pairings: Pairings, allowed: Bools) -> bool:
    """Return whether no two allowed pairings (P,) share a measurement or a landmark."""
    return bool(allowed.any()) and all(np.bincount(n[allowed]).max() == 1 for n in (pairings.row, pairings.column))


def _whole(pairings: Pairings, which: Ints) -> JointAssignment | None:
    """Return the hypothesis that has all pairings `which` (n,).

    Return None if a pairing is outside the gate given all others, or if the hypothesis is better without the pairing. This
    test needs one inverse of the joint covariance. The growth of a hypothesis needs one inverse for each step.
    """
    residual, rarity = pairings.residual[which], pairings.rarity[which]
    size, dimension = residual.shape
    covariance = pairings.covariance[which][:, :, which].reshape(size * dimension, -1)
    precision = np.linalg.inv(covariance)
    pull = (precision @ residual.ravel()).reshape(size, dimension)
    each = np.arange(size)
    given_others = precision.reshape(size, dimension, size, dimension)[each, :, each]
    squared = np.einsum("pi,pi->p", pull, np.linalg.solve(given_others, pull[..., None])[..., 0])
    margin = rarity - 0.5 * (squared - np.linalg.slogdet(given_others / (2 * np.pi))[1])
    if not ((squared <= pairings.gate) & (margin > 0)).all():
        return None
    spread = np.linalg.slogdet(2 * np.pi * covariance)[1]
    odds = float(rarity.sum() - 0.5 * (residual.ravel() @ pull.ravel() + spread))
    return JointAssignment(which, margin, np.zeros(size, dtype=bool), odds)


def _best(pairings: Pairings, odds: Floats, allowed: Bools) -> tuple[Ints, float]:
    """Return the best hypothesis (n,) of allowed pairings and its log odds. Without a likely pairing, the hypothesis is
    empty and its log odds are 0."""
    best, most = np.zeros(0, dtype=np.int64), 0.0
    seeds = np.flatnonzero(allowed)
    seeds = seeds[np.argsort(-odds[seeds], kind="stable")][:_SEEDS]
    tried = np.zeros(len(odds), dtype=bool)
    for seed in seeds.tolist():
        if tried[seed]:
            continue
        chosen, total = _grow(pairings, odds, allowed, seed)
        tried[chosen] = True  # From the chosen pairings, nearly the same hypothesis would grow again.
        if total > most:
            best, most = chosen, total
    return best, most


def _grow(pairings: Pairings, odds: Floats, allowed: Bools, seed: int) -> tuple[Ints, float]:
    """Return the hypothesis (n,) that grows from the pairing `seed`, and its log odds."""
    size, dimension = pairings.residual.shape
    residual, covariance = pairings.residual.copy(), pairings.covariance.reshape(size * dimension, -1).copy()
    left, total, chosen, current = allowed.copy(), 0.0, list[int](), odds
    pairing = seed
    while True:
        chosen.append(pairing)
        total += float(current[pairing])
        left &= (pairings.row != pairings.row[pairing]) & (pairings.column != pairings.column[pairing])
        if not left.any():
            break
        own = slice(pairing * dimension, (pairing + 1) * dimension)
        gain = np.linalg.solve(covariance[own, own], covariance[own]).T
        residual = residual - (gain @ residual[pairing]).reshape(size, dimension)
        covariance = covariance - gain @ covariance[own]
        which = np.flatnonzero(left)
        current = np.full(size, -np.inf)
        blocks = _blocks(covariance.reshape(size, dimension, size, dimension))
        current[which] = _odds(pairings, residual, blocks, which)
        pairing = int(np.argmax(current))
        if not current[pairing] > 0:
            break
    return np.array(chosen, dtype=np.int64), total


def _blocks(covariance: Floats) -> Floats:
    """Return the covariance (P, D, D) of each single pairing."""
    each = np.arange(len(covariance))
    return covariance[each, :, each]


def _odds(pairings: Pairings, residual: Floats, blocks: Floats, which: Ints | slice = slice(None)) -> Floats:
    """Return the log odds (p,) of pairings over new things. It is -inf for a pairing outside the gate."""
    r, s = residual[which], blocks[which]
    squared = np.einsum("pi,pi->p", r, np.linalg.solve(s, r[..., None])[..., 0])
    spread = np.linalg.slogdet(2 * np.pi * s)[1]
    return np.where(squared <= pairings.gate, pairings.rarity[which] - 0.5 * (squared + spread), -np.inf)
