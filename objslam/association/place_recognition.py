"""Place recognition: one constellation of landmarks found in another, by how the landmarks lie to each other.

A robot that comes back after a drift of metres finds no landmark where it expects it. A single one could be any of its
class. Several that fit at once, under one shift and turn that the drift allows, are evidence. It is measured by the Bayes
factor of "these landmarks are those" against "all of them are new".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import AssociationSettings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import POSSIBLE_MOTION, SAME_POINT_WIDE

MIN_LANDMARKS = 2
"""The fewest landmarks by which a place is recognised."""
POSE_FLOOR = (0.02, 0.02, 0.01)
"""x, y (m) and yaw (rad): no pose is taken to be known better than that relative to another one."""
_BENT, _BENT_PER_M = 0.07, 0.02  # How much a neighbourhood is bent in itself: m, and m per m from the robot.
_MARGIN = 2.0  # The strip (m) around all landmarks that belongs to the area over which their density is taken.
_REFINEMENTS = 3  # The Gauss-Newton steps of a hypothesis, alone and with its assignment; all start close to the end.
_CANDIDATES = 3000  # The most pairs of a landmark here and one there; every two of them are a hypothesis.
_HYPOTHESES = 2000  # The most pairs of candidates that make a hypothesis, the longest bases first; larger costs time.
_VERIFIED = 20  # The most hypotheses, by a quick score, whose best assignment is found; larger costs time.
_GAINS_AT_ONCE = 200_000  # The gains computed together; larger needs more memory.
_MIN_BASE = 0.3  # The least distance (m) of two landmarks that tell a heading.
_SAME_SHIFT, _SAME_TURN = 0.5, 0.2  # The m and rad within which two corrections are one place, and do not compete.


@dataclass(frozen=True)
class Constellation:
    """Landmarks of one neighbourhood: position (N, 3) m, covariance (N, 3, 3) m^2 in that neighbourhood, label (N,)."""

    position: Floats
    covariance: Floats
    label: Ints


def neighbourhood(position: Floats, covariance: Floats, label: Ints, pivot: Floats) -> Constellation:
    """The landmarks as they lie around the pivot (2,) m; those further away are less certain relative to the rest."""
    bent = _BENT**2 + _BENT_PER_M**2 * ((position[:, :2] - pivot) ** 2).sum(axis=1)
    return Constellation(position, covariance + bent[:, None, None] * np.eye(3), label)


def label_densities(position: Floats, label: Ints) -> Floats:
    """(N,) landmarks per m^2 that have the label of each one, over the area in which there are landmarks."""
    extent = position[:, :2].max(axis=0) - position[:, :2].min(axis=0) + 2 * _MARGIN
    return np.asarray(np.bincount(label)[label] / float(np.prod(extent)))


@dataclass(frozen=True)
class Recognition:
    """One constellation found in another.

    correction: (4, 4) planar, takes the first to the second. pairs: (P, 2) indices of the same landmark in the first and in
    the second. evidence: log Bayes factor against "all are new". lead: how much more that is than for the best other place.
    """

    correction: Floats
    pairs: Ints
    evidence: float
    lead: float

    def is_sure(self, settings: AssociationSettings) -> bool:
        """Whether a loop may be closed by it."""
        enough = self.evidence >= settings.loop_evidence and self.lead >= settings.loop_lead
        return enough and len(self.pairs) >= MIN_LANDMARKS


def recognise_place(
    here: Constellation, there: Constellation, pivot: Floats, prior: Floats, density: Floats, possible: Bools
) -> Recognition | None:
    """The correction, within the drift, that makes landmarks `here` (N) some of those `there` (M); None where nothing fits.

    Args:
        pivot: (2,) m, the point about which the correction turns.
        prior: (3, 3) covariance of the correction, with mean zero: x, y (m), yaw (rad).
        density: (N,) landmarks `there` per m^2 that have the label of each one here.
        possible: (N, M) which of them may be the same.
    """
    problem = _problem(here, there, pivot, prior, density, possible)
    a, b = _candidates(problem)
    if len(a) == 0:
        return None
    x = _solve_seeds(problem, _seeds(problem, a, b))
    x = x[np.einsum("hi,ij,hj->h", x, problem.weight, x) <= POSSIBLE_MOTION]
    # first rank all, where each landmark may take any partner; then only the best get a one-to-one assignment
    order = np.argsort(-_quick_score(problem, a, b, x), kind="stable")[:_VERIFIED]
    found = [result for h in order.tolist() if (result := _evidence(problem, a, b, x[h])) is not None]
    if not found:
        return None
    evidence, best, pairs = max(found, key=lambda one: one[0])
    others = [e for e, other, _ in found if not _is_same(best, other)]
    return Recognition(_correction(best, pivot), pairs, evidence, evidence - max([0.0, *others]))


@dataclass(frozen=True)
class _Problem:
    """offset, target: (N, 3) and (M, 3) m, landmarks here and there from the pivot. information: (N, M, 3, 3) of each pair.
    spread: (N, M) m, its standard deviation. peak: (N, M) what it gains at best. weight: (3, 3) inverse of the prior."""

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
    # only in the plane, because the height of a landmark says little about which one it is
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


def _is_same(one: Floats, other: Floats) -> bool:
    return bool(np.hypot(*(one - other)[:2]) < _SAME_SHIFT and abs(one[2] - other[2]) < _SAME_TURN)


def _correction(x: Floats, pivot: Floats) -> Floats:
    """The pose (4, 4), in map, of a correction (3,) about the pivot."""
    pose = lift_se2(x)
    pose[:2, 3] += pivot - pose[:2, :2] @ pivot
    return pose


def _moved(offset: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Offsets (..., N, 3) under corrections (..., 3), and their Jacobians (..., N, 3, 3)."""
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
    """The C pairs of landmarks (C,), (C,) that may be the same within the drift.

    Of very many, those whose landmark here could be the fewest there: they tell most.
    """
    distance = np.linalg.norm(problem.offset[:, None, :2] - problem.target[None, :, :2], axis=2)
    turned = np.linalg.norm(problem.offset[:, :2], axis=1) * min(float(np.sqrt(problem.prior[2, 2])), 1.0)
    shifted = float(np.sqrt(np.linalg.eigvalsh(problem.prior[:2, :2])[-1]))
    a, b = np.nonzero(problem.possible & (distance <= 4 * (shifted + turned[:, None] + problem.spread)))
    if len(a) > _CANDIDATES:
        some = np.sort(np.argsort(np.bincount(a)[a], kind="stable")[:_CANDIDATES])
        a, b = a[some], b[some]
    return a, b


def _seeds(problem: _Problem, a: Ints, b: Ints) -> Ints:
    """Hypotheses (H, 2, 2): each candidate alone (as twice the same), and every two candidates that fit each other."""
    single = np.stack([np.arange(len(a))] * 2, axis=1)
    i, j = np.triu_indices(len(a), 1)
    differ = (a[i] != a[j]) & (b[i] != b[j])
    i, j = i[differ], j[differ]
    one = np.linalg.norm(problem.offset[a[i], :2] - problem.offset[a[j], :2], axis=1)
    two = np.linalg.norm(problem.target[b[i], :2] - problem.target[b[j], :2], axis=1)
    fits = (np.abs(one - two) <= 3 * np.hypot(problem.spread[a[i], b[i]], problem.spread[a[j], b[j]])) & (one > _MIN_BASE)
    i, j = i[fits], j[fits]
    if len(i) > _HYPOTHESES:  # a longer base tells the heading better
        longest = np.argsort(-one[fits], kind="stable")[:_HYPOTHESES]
        i, j = i[longest], j[longest]
    pairs = np.concatenate([single, np.stack([i, j], axis=1)])
    return np.stack([a[pairs], b[pairs]], axis=2)


def _solve_seeds(problem: _Problem, seeds: Ints) -> Floats:
    """The corrections (H, 3) that best explain the seeds (H, 2, 2) and the prior."""
    a, b = seeds[:, :, 0], seeds[:, :, 1]
    information = problem.information[a, b]
    alone = a[:, 0] == a[:, 1]
    information[alone] /= 2  # a single candidate counts once
    # a base of two gives the heading in closed form, so that Gauss-Newton starts close to the solution
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
    """The gain (H,) of corrections (H, 3) if each landmark takes its best partner; a, b: (C,) candidates, a increasing."""
    score = -0.5 * np.einsum("hi,ij,hj->h", x, problem.weight, x)
    first = np.flatnonzero(np.diff(a, prepend=-1))
    size = max(1, _GAINS_AT_ONCE // len(a))
    for begin in range(0, len(x), size):
        part = slice(begin, begin + size)
        gain = _gains(problem, a, b, x[part])
        score[part] += np.maximum(np.maximum.reduceat(gain, first, axis=1), 0.0).sum(axis=1)
    return score


def _gains(problem: _Problem, a: Ints, b: Ints, x: Floats) -> Floats:
    """Log likelihood ratio (..., C) of pairs (C,) against new landmarks under corrections (..., 3); -inf beyond the gate."""
    miss = problem.target[b] - _moved(problem.offset, x)[0][..., a, :]
    squared = np.einsum("...ci,cij,...cj->...c", miss, problem.information[a, b], miss)
    return np.where(squared <= SAME_POINT_WIDE, problem.peak[a, b] - 0.5 * squared, -np.inf)


def _evidence(problem: _Problem, one: Ints, two: Ints, x: Floats) -> tuple[float, Floats, Ints] | None:
    """The log Bayes factor of a correction (3,) refined with the best assignment of candidates (C,), its pairs (P, 2)."""
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
    # Laplace's approximation: the prior's density at x times the volume that the landmarks leave open
    occam = 0.5 * (np.linalg.slogdet(problem.weight)[1] - np.linalg.slogdet(hessian)[1])
    return float(final.sum() - 0.5 * x @ problem.weight @ x + occam), x, np.stack([a, b], axis=1)
