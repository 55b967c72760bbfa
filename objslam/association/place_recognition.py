"""Place recognition: find one constellation of landmarks in another by the landmarks' relative positions.

If several landmarks fit under one shift and turn within the drift, this is evidence for the place. The evidence is a Bayes
factor. It compares two hypotheses: the landmarks here are the landmarks there, or all landmarks here are new.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.config import AssociationSettings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import POSSIBLE_MOTION, SAME_POINT_WIDE

MIN_LANDMARKS = 2
"""The fewest common landmarks for recognising a place. A larger number recognises fewer places."""
POSE_FLOOR = (0.02, 0.02, 0.01)
"""The least standard deviations of a relative pose, in x, y (m) and yaw (rad). Larger values trust it less."""
_BENT, _BENT_PER_M = 0.07, 0.02
"""The deformation of a neighbourhood: a constant (m), and a part per metre from the pivot. Larger values accept pairs that
fit less well."""
_MARGIN = 2.0
"""The margin (m) on each side of the rectangle around all landmarks in which their density is computed. With a larger
margin, landmarks count as sparser, so a match is more evidence."""
_REFINEMENTS = 3  # The Gauss-Newton steps of a hypothesis and of its assignment. Few are enough from a close start.
_CANDIDATES = 3000
"""The most pairs of a landmark `here` and a landmark `there` that are tried. Two pairs form a hypothesis. A larger number
costs time."""
_HYPOTHESES = 2000  # The most hypotheses of two pairs, those with the longest bases. A larger number costs time.
_VERIFIED = 20  # The number of hypotheses with the best quick scores that get an assignment. A larger number costs time.
_GAINS_AT_ONCE = 200_000  # The most gains computed together. A larger value needs more memory.
_ROWS_AT_ONCE = 64
"""The number of pairs that are combined with all later pairs at once. With a larger number, the arrays do not fit into the
cache of a processor: 256 took 1.5 times as long as 64, and 1024 took 2.8 times as long. 16 took as long as 64."""
_MIN_BASE = 0.3
"""The least distance (m) between two landmarks that determine a heading. A larger distance leaves fewer hypotheses of two
pairs."""
_SAME_SHIFT, _SAME_TURN = 0.5, 0.2
"""The largest difference (m, rad) of two corrections that count as one place. Larger values hide repetitions."""


@dataclass(frozen=True)
class Constellation:
    """Landmarks of one neighbourhood. position: (N, 3) m. covariance: (N, 3, 3) m^2 relative to the neighbourhood. label:
    (N,)."""

    position: Floats
    covariance: Floats
    label: Ints


def neighbourhood(position: Floats, covariance: Floats, label: Ints, pivot: Floats) -> Constellation:
    """Make a constellation of landmarks. Drift deforms a neighbourhood, so the covariances get larger with the distance.

    pivot: (2,) m, the point from which the horizontal distance counts.
    """
    bent = _BENT**2 + _BENT_PER_M**2 * ((position[:, :2] - pivot) ** 2).sum(axis=1)
    return Constellation(position, covariance + bent[:, None, None] * np.eye(3), label)


def label_densities(position: Floats, label: Ints) -> Floats:
    """Return for each landmark the number (N,) of landmarks of its label per m^2 of the area that contains all landmarks."""
    extent = position[:, :2].max(axis=0) - position[:, :2].min(axis=0) + 2 * _MARGIN
    return np.asarray(np.bincount(label)[label] / float(np.prod(extent)))


@dataclass(frozen=True)
class Recognition:
    """One constellation found in another.

    correction: (4, 4) planar, from the first to the second. pairs: (P, 2) indices of common landmarks in the first and the
    second. evidence: the logarithm of the Bayes factor against the hypothesis that all landmarks are new. lead: the evidence
    minus the evidence of the second-best place. The evidence of the second-best place counts as at least 0.
    """

    correction: Floats
    pairs: Ints
    evidence: float
    lead: float

    def is_sure(self, settings: AssociationSettings) -> bool:
        """Return whether evidence, lead and number of landmarks are enough to close a loop."""
        enough = self.evidence >= settings.loop_evidence and self.lead >= settings.loop_lead
        return enough and len(self.pairs) >= MIN_LANDMARKS

    def against(self, other: Self | None) -> Self:
        """Return this recognition, with its lead limited to its lead over `other`. None counts as the evidence 0."""
        return self if other is None else replace(self, lead=min(self.lead, self.evidence - max(other.evidence, 0.0)))


def recognise_place(
    here: Constellation,
    there: Constellation,
    pivot: Floats,
    prior: Floats,
    density: Floats,
    possible: Bools,
    alike: Floats | float = 0.0,
) -> Recognition | None:
    """Find the correction within the drift that moves landmarks `here` (N) onto landmarks `there` (M). Return None if none
    fits.

    pivot: (2,) m, the point about which the correction turns. prior: (3, 3) covariance of the correction in x, y (m) and yaw
    (rad), with mean zero. density: (N,) number of landmarks `there` per m^2 that have the label of each landmark `here`.
    possible: (N, M) which pairs may be the same landmark. alike: (N, M) the log odds of each pair from its appearance.
    """
    centre = np.append(pivot, 0.0)
    total = here.covariance[:, None] + there.covariance
    planar = total[:, :, :2, :2]  # The height of a landmark says little about its identity.
    problem = _Problem(
        offset=here.position - centre,
        target=there.position - centre,
        information=np.asarray(np.linalg.inv(total)),
        spread=np.sqrt(np.trace(planar, axis1=2, axis2=3) / 2),
        peak=-np.log(2 * np.pi) - 0.5 * np.log(np.linalg.det(planar)) - np.log(density)[:, None] + alike,
        prior=prior,
        weight=np.asarray(np.linalg.inv(prior)),
        possible=possible,
    )
    a, b = _candidates(problem)
    if len(a) == 0:
        return None
    x = _solve_seeds(problem, _seeds(problem, a, b))
    x = x[np.einsum("hi,ij,hj->h", x, problem.weight, x) <= POSSIBLE_MOTION]
    # In the quick score, several landmarks may share a partner. Only the best hypotheses get a one-to-one assignment.
    order = np.argsort(-_quick_score(problem, a, b, x), kind="stable")[:_VERIFIED]
    evidence, x, pairs = _assigned(problem, a, b, x[order])
    if not len(evidence):
        return None
    best = int(evidence.argmax())
    apart = np.abs(x - x[best])
    other = (np.hypot(apart[:, 0], apart[:, 1]) >= _SAME_SHIFT) | (apart[:, 2] >= _SAME_TURN)
    correction = lift_se2(x[best])
    correction[:2, 3] += pivot - correction[:2, :2] @ pivot
    lead = evidence[best] - evidence[other].max(initial=0.0)
    return Recognition(correction, pairs[best], float(evidence[best]), float(lead))


def repetition(
    position: Floats,
    covariance: Floats,
    label: Ints,
    here: Bools,
    together: Bools,
    pivot: Floats,
    prior: Floats,
    density: Floats,
) -> Recognition | None:
    """Return the best match of some landmarks with others that a frame shows beside them. None if nothing matches.

    Two landmarks in one frame cannot be the same. So the match shows how far the place repeats itself, as the doors of a
    corridor do.

    Args:
        position, covariance, label: (N, 3) m, (N, 3, 3) m^2, (N,) of all landmarks.
        here: (N,) which ones are matched.
        together: (N, N) whether some frame shows both.
        pivot, prior: as in `recognise_place`.
        density: (N,) as in `label_densities`.
    """
    apart = here[:, None] & together & (label[:, None] == label)
    np.fill_diagonal(apart, False)
    one, two = np.flatnonzero(apart.any(axis=1)), np.flatnonzero(apart.any(axis=0))
    if not len(one):
        return None
    a, b = (neighbourhood(position[which], covariance[which], label[which], pivot) for which in (one, two))
    return recognise_place(a, b, pivot, prior, density[one], apart[np.ix_(one, two)])


@dataclass(frozen=True)
class _Problem:
    """The matching problem of `recognise_place`, with N landmarks `here` and M landmarks `there`.

    offset: (N, 3) m, target: (M, 3) m: the landmarks `here` and `there` relative to the pivot. information: (N, M, 3, 3)
    m^-2, the inverse covariance of the offset between two of them. spread: (N, M) m, the horizontal standard deviation of
    this offset. peak: (N, M) the gain of a pair at distance 0. possible: (N, M) whether both may be one landmark. prior: (3,
    3) covariance of the correction in x, y (m) and yaw (rad). weight: (3, 3) the inverse of `prior`.
    """

    offset: Floats
    target: Floats
    information: Floats
    spread: Floats
    peak: Floats
    prior: Floats
    weight: Floats
    possible: Bools


def _moved(offset: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return offsets (..., N, 3) under corrections (..., 3), and their Jacobians (..., N, 3, 3)."""
    turned_x, turned_y = _turned(offset, x)
    z = np.broadcast_to(offset[..., 2], turned_x.shape)
    moved = np.stack([turned_x + x[..., 0, None], turned_y + x[..., 1, None], z], axis=-1)
    jacobian = np.zeros((*turned_x.shape, 3, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -turned_y, turned_x
    return moved, jacobian


def _turned(offset: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return the x and the y (..., N) of offsets (..., N, 3), turned by the yaw of corrections (..., 3)."""
    cos, sin = np.cos(x[..., 2, None]), np.sin(x[..., 2, None])
    return cos * offset[..., 0] - sin * offset[..., 1], sin * offset[..., 0] + cos * offset[..., 1]


def _candidates(problem: _Problem) -> tuple[Ints, Ints]:
    """Return the pairs (C,), (C,) of landmarks `here` and `there` that may be one landmark within the drift.

    At most `_CANDIDATES` pairs remain. Landmarks `here` with the fewest partners go first.
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
    """Return hypotheses (H, 2, 2) of two pairs each. Either the distance between the two landmarks `here` fits the distance
    between the two landmarks `there`, or both pairs are the same."""
    single = np.stack([np.arange(len(a))] * 2, axis=1)
    here, there = (np.linalg.norm(p[:, None, :2] - p[None, :, :2], axis=2) for p in (problem.offset, problem.target))
    variance = (3 * problem.spread[a, b]) ** 2
    found = []
    for begin in range(0, len(a), _ROWS_AT_ONCE):
        rows, later = slice(begin, begin + _ROWS_AT_ONCE), slice(begin, None)
        one, two = here[a[rows]][:, a[later]], there[b[rows]][:, b[later]]
        fits = (one - two) ** 2 <= variance[rows, None] + variance[later]
        fits &= (one > _MIN_BASE) & (b[rows, None] != b[later])
        i, j = np.nonzero(np.triu(fits, 1))
        found.append(np.stack([i, j]) + begin)
    i, j = np.concatenate(found, axis=1)
    if len(i) > _HYPOTHESES:  # A longer base determines the heading better.
        longest = np.argsort(-here[a[i], a[j]], kind="stable")[:_HYPOTHESES]
        i, j = i[longest], j[longest]
    pairs = np.concatenate([single, np.stack([i, j], axis=1)])
    return np.stack([a[pairs], b[pairs]], axis=2)


def _solve_seeds(problem: _Problem, seeds: Ints) -> Floats:
    """Return the corrections (H, 3) that best explain the seeds (H, 2, 2) and the prior."""
    a, b = seeds[:, :, 0], seeds[:, :, 1]
    information = problem.information[a, b]
    alone = a[:, 0] == a[:, 1]
    information[alone] /= 2  # A pair alone is in its hypothesis twice.
    # Two landmarks give the heading in closed form, so Gauss-Newton starts near the solution.
    base, other = problem.offset[a[:, 1]] - problem.offset[a[:, 0]], problem.target[b[:, 1]] - problem.target[b[:, 0]]
    angle = np.arctan2(other[:, 1], other[:, 0]) - np.arctan2(base[:, 1], base[:, 0])
    x = np.zeros((len(seeds), 3))
    x[:, 2] = np.where(alone, 0.0, (angle + np.pi) % (2 * np.pi) - np.pi)
    begin = np.arange(0, 2 * len(seeds), 2)
    for _ in range(_REFINEMENTS):
        x = _gauss_newton(problem, a.ravel(), b.ravel(), begin, information.reshape(-1, 3, 3), x)[0]
    return x


def _gauss_newton(problem: _Problem, a: Ints, b: Ints, begin: Ints, information: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return the corrections (H, 3) after one Gauss-Newton step, and the Hessians (H, 3, 3).

    a, b: (P,) the pairs of all corrections, one correction after the other. begin: (H,) the first pair of each correction.
    Each correction has a pair. information: (P, 3, 3) m^-2, of the pairs.
    """
    owner = np.repeat(np.arange(len(x)), np.diff(begin, append=len(a)))
    at, jacobian = (part[:, 0] for part in _moved(problem.offset[a][:, None], x[owner]))
    weighted = np.swapaxes(jacobian, 1, 2) @ information
    hessian = problem.weight + np.add.reduceat(weighted @ jacobian, begin)
    pull = (weighted @ (problem.target[b] - at)[..., None])[..., 0]
    gradient = np.add.reduceat(pull, begin) - x @ problem.weight
    return x + np.linalg.solve(hessian, gradient[..., None])[..., 0], hessian


def _quick_score(problem: _Problem, a: Ints, b: Ints, x: Floats) -> Floats:
    """Return the gain (H,) of corrections (H, 3) if each landmark takes its best partner. a, b: (C,) pairs, sorted by a.

    Under one correction, few of the pairs are close. Only the close pairs get a gain. Gains for all pairs would take more
    than twice as long."""
    score = -0.5 * np.einsum("hi,ij,hj->h", x, problem.weight, x)
    moved = np.stack(_turned(problem.offset, x)) + x.T[:2, :, None]
    target, reach = problem.target[b, :2].T, 2 * SAME_POINT_WIDE * problem.spread[a, b] ** 2
    up = problem.target[b, 2] - problem.offset[a, 2]
    size = max(1, _GAINS_AT_ONCE // len(a))
    for begin in range(0, len(x), size):
        off = target[:, None] - moved[:, begin : begin + size].take(a, axis=2)
        # The squared distance in standard deviations is at least that along the largest axis, whose variance is below the
        # trace.
        row, pair = np.nonzero(off[0] * off[0] + off[1] * off[1] <= reach)
        if len(row):
            gain = _gain(problem, a[pair], b[pair], np.stack([*off[:, row, pair], up[pair]], axis=1))
            first = np.flatnonzero(np.diff(row * len(problem.offset) + a[pair], prepend=-1))
            best = np.maximum(np.maximum.reduceat(gain, first), 0.0)
            score[begin : begin + size] += np.bincount(row[first], best, len(off[0]))
    return score


def _gains(problem: _Problem, a: Ints, b: Ints, x: Floats) -> Floats:
    """Return the gains (H, C) of pairs a, b (C,) under corrections (H, 3). A gain is -inf outside the gate.

    A gain is the log likelihood ratio of two explanations of a pair: both are one landmark, or the landmark `here` is new.
    """
    return _gain(problem, a, b, problem.target[b] - _moved(problem.offset, x)[0][:, a])


def _gain(problem: _Problem, a: Ints, b: Ints, miss: Floats) -> Floats:
    """Return the gains (..., C) of pairs (C,) whose positions differ by `miss` (..., C, 3) m."""
    x, y, z = miss[..., 0], miss[..., 1], miss[..., 2]
    of = problem.information[a, b].T  # Symmetric. Written out, this takes half the time of an einsum.
    squared = (
        (of[0, 0] * x + 2 * (of[0, 1] * y + of[0, 2] * z)) * x + (of[1, 1] * y + 2 * of[1, 2] * z) * y + of[2, 2] * z**2
    )
    return np.where(squared <= SAME_POINT_WIDE, problem.peak[a, b] - 0.5 * squared, -np.inf)


def _assigned(problem: _Problem, one: Ints, two: Ints, x: Floats) -> tuple[Floats, Floats, list[Ints]]:
    """Refine corrections (H, 3) with the best assignments (P, 2). Return evidence (G,), corrections (G, 3) and assignments.

    G <= H: a correction is left out if no pair gains, or if a pair leaves its gate. one, two: (C,) the possible pairs.
    """
    gain = np.zeros(problem.possible.shape)
    hessian = np.zeros((len(x), 3, 3))
    pairs: list[Ints] = []
    for _ in range(_REFINEMENTS):
        pairs, kept = [], []
        for h, gains in enumerate(np.maximum(_gains(problem, one, two, x), 0.0)):
            gain[one, two] = gains
            a, b = linear_sum_assignment(-gain)
            good = gain[a, b] > 0
            if good.any():
                pairs.append(np.stack([a[good], b[good]], axis=1))
                kept.append(h)
        if not pairs:
            return np.zeros(0), np.zeros((0, 3)), []
        a, b = np.concatenate(pairs).T
        begin = np.cumsum([0, *map(len, pairs[:-1])])
        x, hessian = _gauss_newton(problem, a, b, begin, problem.information[a, b], x[kept])
    at = _moved(problem.offset[a][:, None], np.repeat(x, [len(p) for p in pairs], axis=0))[0][:, 0]
    final = np.add.reduceat(_gain(problem, a, b, problem.target[b] - at), begin)
    # Laplace's approximation: the prior density at x times the volume that the landmarks leave open.
    occam = 0.5 * (np.linalg.slogdet(problem.weight)[1] - np.linalg.slogdet(hessian)[1])
    evidence = final - 0.5 * np.einsum("hi,ij,hj->h", x, problem.weight, x) + occam
    inside = np.isfinite(final)
    return evidence[inside], x[inside], [p for p, good in zip(pairs, inside.tolist(), strict=True) if good]
