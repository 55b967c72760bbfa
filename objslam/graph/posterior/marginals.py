"""Compute marginal covariances of landmarks, even if the graph does not determine all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy import sparse

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.rotation import skew
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.factors.priors import point_prior
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.optimizers import indeterminate
from objslam.graph.outlier_rejection import Near, order_near
from objslam.graph.posterior.inverse import LEAST_PIVOT, Inverse
from objslam.graph.variables import L0, X0

HELD = 1.0
"""The standard deviation (m) of the prior that each landmark gets if the linear system is indeterminate. If the standard
deviation of a landmark is still above half of this value, no measurement determines the landmark. A larger value constrains
the landmarks less. With too large a value, the system stays indeterminate."""

_DIRECTIONS = 20
"""The number of directions in which correlations between landmarks are kept. The shift, turn and size of a map take seven
directions. With a larger number, the bends of a long path also count, and the search takes longer."""
_ITERATIONS = 3
"""The number of steps of the search for the directions in which correlations are kept. More steps are more exact, and take
longer."""


@dataclass(frozen=True)
class SolvedGraph:
    """A graph of GTSAM at its solution. Its normal equations are factored only once."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values

    @cached_property
    def inverse(self) -> Inverse | None:
        """The inverse of the normal equations, None if the system is indeterminate."""
        system, keys, zero = self.graph.linearize(self.values), sorted(self.values.keys()), self.values.zeroVectors()
        row, column, value = system.sparseJacobian_()
        entries = (value, (row.astype(np.int64) - 1, column.astype(np.int64) - 1))
        variable = np.repeat(np.arange(len(keys)), [len(zero.at(key)) for key in keys])
        jacobian = sparse.csr_matrix(entries, shape=(int(row.max()), len(variable) + 1))[:, :-1]  # Without the error.
        return Inverse.of(jacobian, keys, variable)


@dataclass(frozen=True)
class SolvedMeasurements:
    """The measurements of a log without fiducials at their solution, with bearings of Gaussian noise.

    The construction of a GTSAM graph takes longer than the factorisation of the normal equations, so the normal equations
    come from arrays.

    measured, association: the measurements, and the landmark of each ray. used: (R,) the rays in the graph. map_T_camera:
    (P, 4, 4). positions: (N, 3) m, NaN for a landmark that is not in the graph. near: an earlier solve. Its order of
    elimination is used if it had the same variables.
    """

    measured: Measurements
    association: Association
    used: Bools
    map_T_camera: Floats
    positions: Floats
    near: Near | None = None

    @cached_property
    def inverse(self) -> Inverse | None:
        """The inverse of the normal equations, None if the system is indeterminate."""
        graph = JointGraph.of(self.measured, self.association, self.used, self.positions, gaussian=True)
        keys = [*(L0 + graph.landmarks).tolist(), *range(X0, X0 + len(self.map_T_camera))]
        jacobian = graph.rows(self.map_T_camera, graph.weak).jacobian
        return Inverse.of(jacobian, keys, graph.blocks, order_near(self.near, graph.landmarks))

    @cached_property
    def _whole(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        return self.measured.whole(self.association.object, self.used, self.map_T_camera, self.positions, "gnc")

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The solved graph as a graph of GTSAM, which names a variable that is not determined."""
        return self._whole[0]

    @property
    def values(self) -> gtsam.Values:
        """The values of `graph`."""
        return self._whole[1]


Solved = SolvedGraph | SolvedMeasurements


def marginal_covariances(solved: Solved, landmarks: Ints, ledger: Ledger) -> Floats:
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


def seen_covariances(solved: Solved, landmarks: Ints, witnesses: Ints, ledger: Ledger) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of landmarks (n,). Each is relative to one keyframe, its witness (n,).

    A covariance is in the camera frame of the witness, without the uncertainty of this camera's pose. In a map by odometry,
    far from its start, nearly all uncertainty of a landmark comes from the pose. If the linear system is indeterminate, the
    ledger gets a warning, and the remaining covariances are NaN.
    """
    covariance = np.full((len(landmarks), 3, 3), np.nan)
    if len(landmarks) == 0:
        return covariance
    values = solved.values
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


def _marginals(solved: Solved, landmarks: Ints) -> Floats:
    covariance = np.array(joint_covariances(solved, [(L0 + j,) for j in landmarks.tolist()])).reshape(-1, 3, 3)
    if not np.isfinite(covariance).all():
        raise RuntimeError("a marginal covariance is not finite")
    return covariance


def joint_covariances(solved: Solved, groups: Sequence[Sequence[int]]) -> list[Floats]:
    """Return the covariance (d, d) of each group of variables, given by their keys, in the order of the keys.

    The normal equations are factored once for all groups. GTSAM eliminates the system again for each group, which takes 20
    times as long for 150 landmarks that were seen together. GTSAM is used only if the normal equations lose too many digits.
    GTSAM names the variable that is not determined. RuntimeError if GTSAM also finds the system indeterminate.
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


def correlated_factor(solved: Solved, landmarks: Ints, covariance: Floats) -> Floats:
    """Return the correlated errors of landmarks (n,), as a factor (n, 3, F), in metres, of their joint covariance.

    covariance: (n, 3, 3) m^2 of the landmarks. A few products with the joint covariance find its strongest directions
    (subspace iteration). So the time grows with the number of landmarks, not with the square of this number. The factor
    comes from the Nystroem approximation, which is nowhere above the joint covariance. F is 0 if the linear system is
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
    good = size > LEAST_PIVOT * size[-1]
    factor = wide @ axes[:, good] / np.sqrt(size[good])
    return np.asarray(root @ factor.reshape(len(white), 3, -1))
