"""Compute marginal covariances of landmarks, even if the graph does not determine all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import gtsam
import numpy as np
from scipy import sparse

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.rotation import skew
from objslam.errors import SolveError
from objslam.graph.factors.priors import point_prior
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order
from objslam.graph.optimizers import indeterminate
from objslam.graph.variables import L0, X0

HELD = 1.0
"""The standard deviation (m) of the prior that each landmark gets if the linear system is indeterminate. If the standard
deviation of a landmark is still above half of this value, no measurement determines the landmark. A larger value constrains
the landmarks less. With too large a value, the system stays indeterminate."""

_LEAST_PIVOT = 1e-11
"""A system has a single solution if every pivot of its information matrix, scaled to 1 on the diagonal, is at least this.
Rounding leaves a pivot of about 1e-15 if a system has no single solution. A larger value refuses more systems that have a
solution, but are badly conditioned."""

_DIRECTIONS = 20
"""The number of directions in which correlations between landmarks are kept. The shift, turn and size of a map take seven.
With a larger number, the bends of a long path count too, and the search takes longer."""
_ITERATIONS = 3
"""The number of steps of the search for the directions in which correlations are kept. More steps are more exact, and take
longer."""
_COLUMNS = 48
"""The number of columns of the inverse that are computed at once. A larger number takes more memory."""
_DENSE, _EACH = 2000, 8
"""The most columns of a dense block of the inverse: in all, and for each requested column. Beyond these limits, single
columns take less time. With larger numbers, dense blocks are used more often."""


@dataclass(frozen=True)
class SolvedGraph:
    """A graph at its solution. Its normal equations are factored only once."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values

    @cached_property
    def inverse(self) -> "_Inverse | None":
        """The inverse of the normal equations, None if the system is indeterminate."""
        return _Inverse.of(self.graph.linearize(self.values), self.values)


def marginal_covariances(solved: SolvedGraph, landmarks: Ints, ledger: Ledger) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of the landmarks (n,).

    If the linear system is indeterminate, the ledger gets a warning, and every landmark gets a temporary prior with the
    standard deviation `HELD`. Landmarks that only this prior determines get NaN. The other covariances are corrected for the
    prior. If the system is still indeterminate, all covariances are NaN.
    """
    try:
        return _marginals(solved, landmarks)
    except RuntimeError as error:
        ledger.warn(
            f"covariances: {indeterminate(error).message}; objects that no measurement determines are left unresolved"
        )
    held, values = solved.graph.clone(), solved.values
    for j in landmarks.tolist():
        held.push_back(point_prior(j, values.atPoint3(L0 + j), HELD))
    try:
        covariance = _marginals(SolvedGraph(held, values), landmarks)
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; no object has a covariance")
        return np.full((len(landmarks), 3, 3), np.nan)
    held_by_more = np.linalg.eigvalsh(covariance)[:, -1] <= (0.5 * HELD) ** 2
    without_prior = np.full_like(covariance, np.nan)
    without_prior[held_by_more] = np.linalg.inv(np.linalg.inv(covariance[held_by_more]) - np.eye(3) / HELD**2)
    return without_prior


def seen_covariances(solved: SolvedGraph, landmarks: Ints, witnesses: Ints, ledger: Ledger) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of landmarks (n,). Each is relative to one keyframe, its witness (n,).

    A covariance is in the camera frame of the witness, without the uncertainty of this camera's pose. In a map by odometry,
    far from its start, nearly all uncertainty of a landmark comes from the pose. If the linear system is indeterminate, the
    ledger gets a warning, and the remaining covariances are NaN.
    """
    covariance, values = np.full((len(landmarks), 3, 3), np.nan), solved.values
    if len(landmarks) == 0:
        return covariance
    try:
        pairs = list(zip(landmarks.tolist(), witnesses.tolist(), strict=True))
        joint = joint_covariances(solved, [(X0 + k, L0 + j) for j, k in pairs])
        for i, (j, k) in enumerate(pairs):
            covariance[i] = in_camera(joint[i], values.atPose3(X0 + k).matrix(), values.atPoint3(L0 + j))
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; objects far from the start are left unresolved")
    return covariance


def in_camera(joint: Floats, map_T_camera: Floats, point: Floats) -> Floats:
    """Return the covariance (3, 3), m^2, of a landmark in the frame of a camera, from the joint covariance (9, 9) of camera
    and landmark.

    The camera comes first in `joint`. map_T_camera: (4, 4) its pose. point: (3,) the position of the landmark in map.
    """
    to_point = map_T_camera[:3, :3].T
    seen = to_point @ (point - map_T_camera[:3, 3])
    to_pose = np.hstack([skew(seen), -np.eye(3)])
    cross = to_pose @ joint[:6, 6:] @ to_point.T
    spread = to_pose @ joint[:6, :6] @ to_pose.T + to_point @ joint[6:, 6:] @ to_point.T
    return np.asarray(spread + cross + cross.T)


def largest_sigma(covariances: Floats) -> Floats:
    """Return the largest standard deviation (n,), m, of each covariance (n, 3, 3). A NaN covariance gives NaN."""
    known = np.isfinite(covariances).all(axis=(1, 2))
    sigma = np.full(len(covariances), np.nan)
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[known])[:, -1], 0.0))
    return sigma


def _marginals(solved: SolvedGraph, landmarks: Ints) -> Floats:
    covariance = np.array(joint_covariances(solved, [(L0 + j,) for j in landmarks.tolist()])).reshape(-1, 3, 3)
    if not np.isfinite(covariance).all():
        raise RuntimeError("a marginal covariance is not finite")
    return covariance


def joint_covariances(solved: SolvedGraph, groups: Sequence[Sequence[int]]) -> list[Floats]:
    """Return the covariance (d, d) of each group of variables, given by their keys, in the order of the keys.

    The normal equations are factored once for all groups. GTSAM eliminates the system again for each group, which takes 20
    times as long for 150 landmarks that were seen together. GTSAM is used only if the normal equations lose too many digits.
    GTSAM names the variable that is not determined. RuntimeError if GTSAM, too, finds the system indeterminate.
    """
    if solved.inverse is not None:
        return solved.inverse.blocks(groups)
    marginals = gtsam.Marginals(solved.graph, solved.values)
    return [_of_marginals(marginals, group) for group in groups]


def _of_marginals(marginals: gtsam.Marginals, keys: Sequence[int]) -> Floats:
    if len(keys) == 1:
        return np.asarray(marginals.marginalCovariance(keys[0]))
    return in_order(marginals.jointMarginalCovariance(list(keys)), keys)


def in_order(joint: gtsam.JointMarginal, keys: Sequence[int]) -> Floats:
    """Return the joint covariance (d, d) of variables in the order of the keys."""
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def correlated_factor(solved: SolvedGraph, landmarks: Ints, covariance: Floats) -> Floats:
    """Return the correlated errors of landmarks (n,), as a factor (n, 3, m), m, of their joint covariance.

    covariance: (n, 3, 3) m^2 of the landmarks. A few products with the joint covariance find its strongest directions
    (subspace iteration). So the time grows with the number of landmarks, not with the square of this number. The factor
    comes from the Nystroem approximation, which is nowhere above the joint covariance. m is 0 if the linear system is
    indeterminate.
    """
    none = np.zeros((len(landmarks), 3, 0))
    inverse = solved.inverse
    if inverse is None or not len(landmarks):
        return none
    at = inverse.columns([L0 + j for j in landmarks.tolist()])
    root = np.linalg.cholesky(covariance)
    white = np.linalg.inv(root)

    def product(vectors: Floats) -> Floats:
        """Return the product of the whitened joint covariance and vectors (3 n, m)."""
        blocks = np.swapaxes(white, 1, 2) @ vectors.reshape(len(white), 3, -1)
        wide = inverse.times(at, blocks.reshape(len(at), -1)).reshape(blocks.shape)
        return np.asarray(white @ wide).reshape(vectors.shape)

    number = min(_DIRECTIONS, len(at))
    basis = np.random.default_rng(0).normal(size=(len(at), number))
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(product(basis))[0]
    wide = product(basis)
    inner = basis.T @ wide
    size, axes = np.linalg.eigh((inner + inner.T) / 2)
    good = size > _LEAST_PIVOT * size[-1]
    factor = wide @ axes[:, good] / np.sqrt(size[good])
    return np.asarray(root @ factor.reshape(len(white), 3, -1))


@dataclass(frozen=True)
class _Inverse:
    """The inverse of the normal equations of a graph, with a part for each variable.

    normal: the normal equations, with columns of length 1. scale: (D,) the lengths of the columns before this scaling.
    begin, end: the columns of each variable, by its key.
    """

    normal: NormalEquations
    scale: Floats
    begin: dict[int, int]
    end: dict[int, int]

    @classmethod
    def of(cls, system: gtsam.GaussianFactorGraph, values: gtsam.Values) -> Self | None:
        """Factor the normal equations. None if the system is indeterminate."""
        keys, zero = sorted(values.keys()), values.zeroVectors()
        size = np.array([len(zero.at(key)) for key in keys])
        begin, end = np.cumsum(size) - size, np.cumsum(size)
        row, column, value = system.sparseJacobian_()
        entries = (value, (row.astype(np.int64) - 1, column.astype(np.int64) - 1))
        shape = int(row.max()), int(end[-1]) + 1
        jacobian = sparse.csr_matrix(entries, shape=shape)[:, :-1]  # The last column is the error.
        scale = np.sqrt(np.asarray(jacobian.power(2).sum(axis=0)).ravel())
        if not (np.isfinite(scale) & (scale > 0)).all():
            return None
        scaled = sparse.csr_matrix(jacobian @ sparse.diags_array(1 / scale))
        try:
            normal = NormalEquations.of(scaled, elimination_order(scaled, np.repeat(np.arange(len(keys)), size)))
        except SolveError:
            return None
        if not normal.least_pivot > _LEAST_PIVOT:
            return None
        first, last = begin.tolist(), end.tolist()
        return cls(normal, scale, dict(zip(keys, first, strict=True)), dict(zip(keys, last, strict=True)))

    @property
    def log_determinant(self) -> float:
        """The log of the determinant of the normal equations."""
        return self.normal.log_determinant + 2 * float(np.log(self.scale).sum())

    def columns(self, keys: Sequence[int]) -> Ints:
        """Return the columns of variables, in the order of the keys."""
        return np.concatenate([np.arange(self.begin[key], self.end[key]) for key in keys])

    def blocks(self, groups: Sequence[Sequence[int]]) -> list[Floats]:
        """Return the block (d, d) of the inverse for each group of variables, in the order of their keys."""
        asked = [self.columns(group) for group in groups]
        every = np.unique(np.concatenate(asked)) if asked else np.zeros(0, dtype=np.int64)
        late = self.normal.late(every, min(_DENSE, _EACH * len(every)))
        dense = self.normal.last_block(late)
        block = (dense + dense.T) / 2 / self.scale[late] / self.scale[late, None]
        # A landmark that few poses see is eliminated early. It takes columns of its own, but the others still need none.
        in_block = [bool(np.isin(own, late).all()) for own in asked]
        alone = iter(self._by_columns([own for own, here in zip(asked, in_block, strict=True) if not here]))
        places = [np.searchsorted(late, own) for own in asked]
        return [block[np.ix_(at, at)] if here else next(alone) for at, here in zip(places, in_block, strict=True)]

    def _by_columns(self, asked: Sequence[Ints]) -> list[Floats]:
        """Return the block (d, d) of the inverse for each group of columns (d,), from whole columns of the inverse."""
        found: list[Floats] = []
        waiting: list[Ints] = []
        for i in range(len(asked)):
            waiting.append(asked[i])
            if sum(map(len, waiting)) < _COLUMNS and i + 1 < len(asked):
                continue
            at = np.concatenate(waiting)
            whole = np.zeros((len(self.scale), len(at)))
            whole[at, np.arange(len(at))] = 1 / self.scale[at]
            columns, first = self.normal.solve(whole), 0
            for own in waiting:
                block = columns[own, first : first + len(own)] / self.scale[own, None]
                found.append((block + block.T) / 2)
                first += len(own)
            waiting = []
        return found

    def times(self, at: Ints, right: Floats) -> Floats:
        """Return the part of the inverse at some columns (d,), times vectors (d, m)."""
        whole = np.zeros((len(self.scale), right.shape[1]))
        whole[at] = right / self.scale[at, None]
        return np.asarray(self.normal.solve(whole)[at] / self.scale[at, None])
