"""Compute marginal covariances of landmarks, even if the graph does not determine all of them."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.rotation import skew
from objslam.graph.factors.priors import point_prior
from objslam.graph.optimizers import indeterminate
from objslam.graph.variables import L0, X0

HELD = 1.0
"""The standard deviation (m) of the prior that each landmark gets if the linear system is indeterminate. If the standard
deviation of a landmark is still above half of this value, no measurement determines the landmark. A larger value constrains
the landmarks less. With too large a value, the system stays indeterminate."""


def marginal_covariances(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints, ledger: Ledger) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of the landmarks (n,) at `values`.

    If the linear system is indeterminate, the ledger gets a warning, and every landmark gets a temporary prior with the
    standard deviation `HELD`. Landmarks that only this prior determines get NaN. The other covariances are corrected for the
    prior. If the system is still indeterminate, all covariances are NaN.
    """
    try:
        return _marginals(graph, values, landmarks)
    except RuntimeError as error:
        ledger.warn(
            f"covariances: {indeterminate(error).message}; objects that no measurement determines are left unresolved"
        )
    held = graph.clone()
    for j in landmarks.tolist():
        held.push_back(point_prior(j, values.atPoint3(L0 + j), HELD))
    try:
        covariance = _marginals(held, values, landmarks)
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; no object has a covariance")
        return np.full((len(landmarks), 3, 3), np.nan)
    held_by_more = np.linalg.eigvalsh(covariance)[:, -1] <= (0.5 * HELD) ** 2
    without_prior = np.full_like(covariance, np.nan)
    without_prior[held_by_more] = np.linalg.inv(np.linalg.inv(covariance[held_by_more]) - np.eye(3) / HELD**2)
    return without_prior


def seen_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints, witnesses: Ints, ledger: Ledger
) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of landmarks (n,). Each is relative to one keyframe, its witness (n,).

    A covariance is in the camera frame of the witness, without the uncertainty of this camera's pose. In a map by odometry,
    far from its start, nearly all uncertainty of a landmark comes from the pose. If the linear system is indeterminate, the
    ledger gets a warning, and the remaining covariances are NaN.
    """
    covariance = np.full((len(landmarks), 3, 3), np.nan)
    if len(landmarks) == 0:
        return covariance
    try:
        marginals = gtsam.Marginals(graph, values)
        for i, (j, k) in enumerate(zip(landmarks.tolist(), witnesses.tolist(), strict=True)):
            joint = marginals.jointMarginalCovariance([X0 + k, L0 + j])
            covariance[i] = in_camera(joint, k, j, values.atPose3(X0 + k).matrix(), values.atPoint3(L0 + j))
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; objects far from the start are left unresolved")
    return covariance


def in_camera(joint: gtsam.JointMarginal, k: int, j: int, map_T_camera: Floats, point: Floats) -> Floats:
    """Return the covariance (3, 3), m^2, of L(j) in the frame of X(k), from their joint marginal.

    map_T_camera: (4, 4) the pose of X(k). point: (3,) the position of L(j) in map.
    """
    x, landmark = X0 + k, L0 + j
    to_point = map_T_camera[:3, :3].T
    seen = to_point @ (point - map_T_camera[:3, 3])
    to_pose = np.hstack([skew(seen), -np.eye(3)])
    cross = to_pose @ joint.at(x, landmark) @ to_point.T
    spread = to_pose @ joint.at(x, x) @ to_pose.T + to_point @ joint.at(landmark, landmark) @ to_point.T
    return np.asarray(spread + cross + cross.T)


def largest_sigma(covariances: Floats) -> Floats:
    """Return the largest standard deviation (n,), m, of each covariance (n, 3, 3). A NaN covariance gives NaN."""
    known = np.isfinite(covariances).all(axis=(1, 2))
    sigma = np.full(len(covariances), np.nan)
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[known])[:, -1], 0.0))
    return sigma


def _marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints) -> Floats:
    marginals = gtsam.Marginals(graph, values)
    covariance = np.array([marginals.marginalCovariance(L0 + j) for j in landmarks.tolist()]).reshape(-1, 3, 3)
    if not np.isfinite(covariance).all():
        raise RuntimeError("a marginal covariance is not finite")
    return covariance
