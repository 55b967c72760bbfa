"""Match two maps that bend: one tilt and one size of each map move all their objects together.

A wrong tilt or size moves a far object by more than a near one. So a transform alone may match the objects of a row to the
neighbours of their true partners. Here, tilt and size are estimated together with the transform. The shared covariances of
the maps are the priors of tilt and size. Unlike independent errors of objects, a tilt and a size cannot move each object its
own way.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from objslam.association.registration.fitting import Problem, jacobian_of, move, one_each
from objslam.association.registration.shapes import STRAIN
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.maps.shared_covariance import jacobian as shared_jacobian
from objslam.core.statistics import SAME_POINT

_BESIDE = 40
"""The largest number of shifts that are tried, beginning with the smallest shift. A shift moves one object onto another
partner. A larger number looks farther around, and takes longer."""
_MOST = 20_000
"""The largest product of the number of tried shifts and the number of objects in map a. With this limit, large maps get few
shifts. In a large map, it is rare that all rows of objects match their neighbours. A larger number takes longer."""
_SIZES = (0.0, -1.0, 1.0, -2.0, 2.0)
"""The sizes at which a search starts, in standard deviations of the size of one map relative to the other. A true size
between two starts is at most half a standard deviation from one of them. The wide gates of the first round allow for this.
More sizes take longer."""
_WIDE = 0.5
"""The share of the standard deviations of tilt and size by which the gates of the first round are wider. 0.5 is half the
step of `_SIZES`. A larger value lets more wrong partners in."""
_ROUNDS = 4
"""The number of rounds of matching and fitting. A larger number takes longer."""
_TIGHT = 1e-6
"""The standard deviation (rad, share) that is added to tilt and size, so that exact maps have a prior. A larger value bends
exact maps."""
_LEAST = 1e-6
"""The least information (1/m^2, 1/rad^2) about each parameter, so that few matches can be solved. A larger value holds
transforms that few matches determine."""


def bent_matches(problem: Problem, x: Floats) -> Ints:
    """Return the pairs (P, 2) of objects of a and b that match, one to one, under the best transform near x (4,).

    The search has many starts: shifts that move one object onto a partner, each at several sizes. After some rounds of
    matching and fitting, the start with the least cost is chosen. The cost is the sum of the squared Mahalanobis distances
    of the matches and of tilt and size, minus twice the limit of a match for each match.
    """
    one, other = problem.a, problem.b
    turn = lift_se2(x[[0, 1, 3]])[:3, :3]
    back = np.eye(3)
    back[:2, :2] = turn[:2, :2].T  # The tilt of b in the frame of a. The size is the same in both.
    prior = one.shared[np.ix_(STRAIN, STRAIN)] + back @ other.shared[np.ix_(STRAIN, STRAIN)] @ back.T + _TIGHT**2 * np.eye(3)
    lever = shared_jacobian(one.position)[:, :, STRAIN]
    own = turn @ one.own @ turn.T
    poses, bends = _starts(problem, x, float(np.sqrt(prior[2, 2])))
    index = np.broadcast_to(np.arange(len(one.label)), (len(poses), len(one.label)))
    told = np.zeros((7, 7))
    told[4:, 4:] = np.linalg.inv(prior)

    def match(wider: Floats | float) -> tuple[Floats, Floats, Floats]:
        """Return the moved objects, the offsets to their partners, and the information, which is 0 without a match."""
        moved = move(poses, one.position + np.einsum("nij,hj->hni", lever, bends))
        partner = problem.nearest(moved, index)
        miss, covariance = other.position[partner] - moved, own + other.own[partner] + wider
        information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        good = one_each(partner, np.einsum("hni,hnij,hnj->hn", miss, information, miss) <= SAME_POINT)
        return moved, miss, information * good[..., None, None]

    wide = _WIDE**2 * turn @ lever @ prior @ np.swapaxes(lever, 1, 2) @ turn.T
    for k in range(_ROUNDS):
        moved, miss, information = match(wide if k == 0 else 0.0)
        change = np.concatenate([jacobian_of(poses, moved), np.broadcast_to(turn @ lever, (*moved.shape, 3))], axis=-1)
        weighted = np.swapaxes(change, -1, -2) @ information
        hessian = (weighted @ change).sum(axis=1) + told + _LEAST * np.eye(7)
        gradient = (weighted @ miss[..., None])[..., 0].sum(axis=1) - np.pad(bends, ((0, 0), (4, 0))) @ told
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        poses, bends = poses + step[:, :4], bends + step[:, 4:]
    moved, miss, information = match(0.0)
    cost = np.einsum("hni,hnij,hnj->h", miss, information, miss) + np.einsum("hi,ij,hj->h", bends, told[4:, 4:], bends)
    best = np.argmin(cost - 2 * SAME_POINT * information.any(axis=(2, 3)).sum(axis=1))
    return _assigned(problem, moved[best], own)


def _starts(problem: Problem, x: Floats, size: float) -> tuple[Floats, Floats]:
    """Return transforms (H, 4), and tilts and sizes (H, 3), to start from. size: the standard deviation of the size."""
    moved = move(x[None], problem.a.position[None])[0]
    one, two = near(problem, moved)
    shift = problem.b.position[two] - moved[one]
    shift = shift[np.argsort((shift**2).sum(axis=1), kind="stable")[: max(min(_BESIDE, _MOST // len(moved)), 1)]]
    poses = x + np.pad(shift, ((1, 0), (0, 1)))
    bends = np.zeros((len(_SIZES), 1, 3))
    bends[:, 0, 2] = size * np.array(_SIZES)
    shape = (len(_SIZES), len(poses), 1)
    return np.tile(poses, (len(_SIZES), 1)), (bends * np.ones(shape)).reshape(-1, 3)


def near(problem: Problem, moved: Floats) -> tuple[Ints, Ints]:
    """Return the pairs of objects of a, moved to (N, 3) m, and objects of b with the same label that may match."""
    widest = sum(float(np.linalg.eigvalsh(m.covariance)[:, -1].max()) for m in (problem.a, problem.b))
    reach = float(np.sqrt(SAME_POINT * widest))
    pairs = KDTree(moved).sparse_distance_matrix(KDTree(problem.b.position), reach, output_type="coo_matrix")
    one, two = (np.asarray(rows, dtype=np.int64) for rows in (pairs.row, pairs.col))
    equal = problem.a.label[one] == problem.b.label[two]
    return one[equal], two[equal]


def _assigned(problem: Problem, moved: Floats, own: Floats) -> Ints:
    """Return the pairs (P, 2) of objects of a and of b, one to one, that together have the least cost (see `bent_matches`).

    moved: (N, 3) m, the places of the objects of a in the frame of b. own: (N, 3, 3) m^2, the covariances of the errors that
    each of them has alone.
    """
    one, two = near(problem, moved)
    miss = problem.b.position[two] - moved[one]
    squared = (miss * np.linalg.solve(own[one] + problem.b.own[two], miss[..., None])[..., 0]).sum(axis=1)
    good = squared <= SAME_POINT
    gain = np.zeros((len(moved), len(problem.b.label)))
    gain[one[good], two[good]] = 2 * SAME_POINT - squared[good]
    a, b = linear_sum_assignment(-gain)
    return np.column_stack([a, b])[gain[a, b] > 0]
