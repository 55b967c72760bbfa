"""The same place, recognised by how its landmarks lie to each other: one constellation of landmarks found in another.

A robot that comes back after a drift of metres finds no landmark where it expects it. A single one could be any of its
class; several that fit at once, under one shift and turn that the drift allows, are evidence. The measure is the Bayes
factor of "these landmarks are those" against "all of them are new".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.geometry import lift_se2
from objslam.types import Bools, Floats, Ints

FEWEST = 2  # landmarks that a place is recognised by
LEAST = (0.02, 0.02, 0.01)  # m, m, rad; no pose is known better than that to another
_EVIDENCE, _LEAD = 7.0, 3.0  # log odds against new landmarks, and against another place
_PLACE, _DISTORTION = 0.07, 0.02  # m, and m per m from the robot: by how much a neighbourhood is bent in itself
_MARGIN = 2.0  # m around all landmarks that could hold some too
_GATE = 16.3  # chi-squared, 3 degrees of freedom, 0.999
_PRIOR_GATE = 14.2  # chi-squared, 3 degrees of freedom, 0.997
_REFINEMENTS = 3
_HYPOTHESES, _CLOSELY = 2000, 20
_AT_ONCE = 200_000  # gains
_BASE = 0.3  # m; two landmarks closer than that tell no heading
_SAME_PLACE, _SAME_HEADING = 0.5, 0.2  # m, rad; hypotheses closer than that are one


@dataclass(frozen=True)
class Constellation:
    """Landmarks of one neighbourhood: position (N, 3) m, covariance (N, 3, 3) m^2 in that neighbourhood, label (N,)."""

    position: Floats
    covariance: Floats
    label: Ints


def neighbourhood(position: Floats, covariance: Floats, label: Ints, pivot: Floats) -> Constellation:
    """The landmarks (N, 3) as they lie around the pivot (2,): what is further away is bent more, against the rest."""
    bent = _PLACE**2 + _DISTORTION**2 * ((position[:, :2] - pivot) ** 2).sum(axis=1)
    return Constellation(position, covariance + bent[:, None, None] * np.eye(3), label)


def densities(position: Floats, label: Ints) -> Floats:
    """(N,) how many landmarks of the label of each there are per m^2 of where landmarks are."""
    extent = position[:, :2].max(axis=0) - position[:, :2].min(axis=0) + 2 * _MARGIN
    return np.asarray(np.bincount(label)[label] / float(np.prod(extent)))


@dataclass(frozen=True)
class Recognition:
    """One constellation found in another.

    correction: (4, 4) what takes the first to the second, planar. pairs: (P, 2) index of a landmark in the first, and of the
    one that it is in the second. evidence: log Bayes factor against "all are new". lead: by how much it exceeds that of the
    best other correction.
    """

    correction: Floats
    pairs: Ints
    evidence: float
    lead: float

    @property
    def sure(self) -> bool:
        """Whether it may be acted on."""
        return self.evidence >= _EVIDENCE and self.lead >= _LEAD and len(self.pairs) >= FEWEST


def recognise(
    here: Constellation, there: Constellation, pivot: Floats, prior: Floats, density: Floats, possible: Bools
) -> Recognition | None:
    """Where, within the drift, the landmarks `here` are some of those `there`; None where nothing fits at all.

    pivot: (2,) m, the place about which the correction turns. prior: (3, 3) its covariance: x, y (m), yaw (rad), mean zero.
    density: (N,) landmarks `there` of the label of each one here, per m^2. possible: (N, M) which may be the same at all.
    """
    problem = _problem(here, there, pivot, prior, density, possible)
    a, b = _candidates(problem)
    if len(a) == 0:
        return None
    x = _solve_seeds(problem, _seeds(problem, a, b))
    x = x[np.einsum("hi,ij,hj->h", x, problem.weight, x) <= _PRIOR_GATE]
    # rank all by what they gain where each landmark may take any partner, then look closely at the best
    order = np.argsort(-_quick_score(problem, a, b, x), kind="stable")[:_CLOSELY]
    found = [result for h in order.tolist() if (result := _evidence(problem, a, b, x[h])) is not None]
    if not found:
        return None
    evidence, best, pairs = max(found, key=lambda one: one[0])
    others = [e for e, other, _ in found if not _same(best, other)]
    return Recognition(_correction(best, pivot), pairs, evidence, evidence - max([0.0, *others]))


@dataclass(frozen=True)
class _Problem:
    """offset: (N, 3) of the landmarks here from the pivot, target: (M, 3) of those there. information: (N, M, 3, 3) of the
    offset of each pair. peak: (N, M) what a pair that fits perfectly gains. weight: (3, 3) the prior's."""

    offset: Floats
    target: Floats
    information: Floats
    spread: Floats
    peak: Floats
    prior: Floats
    weight: Floats
    possible: Bools


def _problem(
    here: Constellation, there: Constellation, pivot: Floats, prior: Floats, density: Floats, possible: Bools
) -> _Problem:
    centre = np.append(pivot, 0.0)
    total = here.covariance[:, None] + there.covariance
    # in the plane: how high a landmark is says little about which one it is
    peak = -np.log(2 * np.pi) - 0.5 * np.log(np.linalg.det(total[:, :, :2, :2])) - np.log(density)[:, None]
    return _Problem(
        offset=here.position - centre,
        target=there.position - centre,
        information=np.asarray(np.linalg.inv(total)),
        spread=np.sqrt(np.trace(total[:, :, :2, :2], axis1=2, axis2=3) / 2),
        peak=peak,
        prior=prior,
        weight=np.asarray(np.linalg.inv(prior)),
        possible=possible,
    )


def _same(one: Floats, other: Floats) -> bool:
    return bool(np.hypot(*(one - other)[:2]) < _SAME_PLACE and abs(one[2] - other[2]) < _SAME_HEADING)


def _correction(x: Floats, pivot: Floats) -> Floats:
    """(4, 4) in map of the correction (3,) about the pivot."""
    pose = lift_se2(x)
    pose[:2, 3] += pivot - pose[:2, :2] @ pivot
    return pose


def _moved(offset: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Offsets (..., N, 3) under corrections (..., 3), and how they move with them (..., N, 3, 3)."""
    cos, sin = np.cos(x[..., 2, None]), np.sin(x[..., 2, None])
    turned_x, turned_y = cos * offset[..., 0] - sin * offset[..., 1], sin * offset[..., 0] + cos * offset[..., 1]
    moved = np.stack(
        [turned_x + x[..., 0, None], turned_y + x[..., 1, None], np.broadcast_to(offset[..., 2], turned_x.shape)], axis=-1
    )
    jacobian = np.zeros((*turned_x.shape, 3, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -turned_y, turned_x
    return moved, jacobian


def _candidates(problem: _Problem) -> tuple[Ints, Ints]:
    """Pairs of landmarks that the drift allows to be the same: (C,), (C,)."""
    distance = np.linalg.norm(problem.offset[:, None, :2] - problem.target[None, :, :2], axis=2)
    turned = np.linalg.norm(problem.offset[:, :2], axis=1) * min(float(np.sqrt(problem.prior[2, 2])), 1.0)
    shifted = float(np.sqrt(np.linalg.eigvalsh(problem.prior[:2, :2])[-1]))
    a, b = np.nonzero(problem.possible & (distance <= 4 * (shifted + turned[:, None] + problem.spread)))
    return a, b


def _seeds(problem: _Problem, a: Ints, b: Ints) -> Ints:
    """Hypotheses (H, 2, 2): each candidate alone (twice the same), and two of them that fit each other."""
    single = np.stack([np.arange(len(a))] * 2, axis=1)
    i, j = np.triu_indices(len(a), 1)
    differ = (a[i] != a[j]) & (b[i] != b[j])
    i, j = i[differ], j[differ]
    one = np.linalg.norm(problem.offset[a[i], :2] - problem.offset[a[j], :2], axis=1)
    two = np.linalg.norm(problem.target[b[i], :2] - problem.target[b[j], :2], axis=1)
    fits = (np.abs(one - two) <= 3 * np.hypot(problem.spread[a[i], b[i]], problem.spread[a[j], b[j]])) & (one > _BASE)
    i, j = i[fits], j[fits]
    if len(i) > _HYPOTHESES:  # the longer the base, the better the heading
        longest = np.argsort(-one[fits], kind="stable")[:_HYPOTHESES]
        i, j = i[longest], j[longest]
    pairs = np.concatenate([single, np.stack([i, j], axis=1)])
    return np.stack([a[pairs], b[pairs]], axis=2)


def _solve_seeds(problem: _Problem, seeds: Ints) -> Floats:
    """The corrections (H, 3) that explain the seeds (H, 2, 2) best, with the prior."""
    a, b = seeds[:, :, 0], seeds[:, :, 1]
    information = problem.information[a, b]
    alone = a[:, 0] == a[:, 1]
    information[alone] /= 2  # the same twice
    # a base of two gives the heading in closed form: from there Gauss-Newton has no far way to go
    base, other = problem.offset[a[:, 1]] - problem.offset[a[:, 0]], problem.target[b[:, 1]] - problem.target[b[:, 0]]
    angle = np.arctan2(other[:, 1], other[:, 0]) - np.arctan2(base[:, 1], base[:, 0])
    x = np.zeros((len(seeds), 3))
    x[:, 2] = np.where(alone, 0.0, (angle + np.pi) % (2 * np.pi) - np.pi)
    for _ in range(_REFINEMENTS):
        x = _gauss_newton(problem, a, b, information, x)[0]
    return x


def _gauss_newton(problem: _Problem, a: Ints, b: Ints, information: Floats, x: Floats) -> tuple[Floats, Floats]:
    """One step for the corrections (..., 3) from pairs a, b (..., P), and the Hessian (..., 3, 3)."""
    at, jacobian = _moved(problem.offset[a], x)
    weighted = np.swapaxes(jacobian, -1, -2) @ information
    hessian = problem.weight + (weighted @ jacobian).sum(axis=-3)
    gradient = (weighted @ (problem.target[b] - at)[..., None])[..., 0].sum(axis=-2) - x @ problem.weight
    return x + np.linalg.solve(hessian, gradient[..., None])[..., 0], hessian


def _quick_score(problem: _Problem, a: Ints, b: Ints, x: Floats) -> Floats:
    """What each correction (H, 3) gains, (H,), were each landmark free to take the partner it likes best.

    a, b: (C,) the pairs that are possible, a in increasing order.
    """
    score = -0.5 * np.einsum("hi,ij,hj->h", x, problem.weight, x)
    first = np.flatnonzero(np.diff(a, prepend=-1))
    size = max(1, _AT_ONCE // len(a))
    for begin in range(0, len(x), size):
        part = slice(begin, begin + size)
        gain = _gains(problem, a, b, x[part])
        score[part] += np.maximum(np.maximum.reduceat(gain, first, axis=1), 0.0).sum(axis=1)
    return score


def _gains(problem: _Problem, a: Ints, b: Ints, x: Floats) -> Floats:
    """Log likelihood ratio (..., C) of pairs (C,) against new landmarks, -inf beyond the gate; x: (..., 3)."""
    miss = problem.target[b] - _moved(problem.offset, x)[0][..., a, :]
    squared = np.einsum("...ci,cij,...cj->...c", miss, problem.information[a, b], miss)
    return np.where(squared <= _GATE, problem.peak[a, b] - 0.5 * squared, -np.inf)


def _evidence(problem: _Problem, one: Ints, two: Ints, x: Floats) -> tuple[float, Floats, Ints] | None:
    """The log Bayes factor of a correction (3,), refined with the best assignment, and its pairs (P, 2).

    one, two: (C,) the pairs that are possible.
    """
    gain = np.zeros(problem.possible.shape)
    for _ in range(_REFINEMENTS):
        gain[one, two] = np.maximum(_gains(problem, one, two, x), 0.0)
        a, b = linear_sum_assignment(-gain)
        good = gain[a, b] > 0
        a, b = a[good], b[good]
        if len(a) == 0:
            return None
        x, hessian = _gauss_newton(problem, a, b, problem.information[a, b], x)
    final = _gains(problem, a, b, x)
    if not np.isfinite(final).all():
        return None
    # Laplace: the prior's density at x times the volume that the landmarks leave open
    occam = 0.5 * (np.linalg.slogdet(problem.weight)[1] - np.linalg.slogdet(hessian)[1])
    return float(final.sum() - 0.5 * x @ problem.weight @ x + occam), x, np.stack([a, b], axis=1)
