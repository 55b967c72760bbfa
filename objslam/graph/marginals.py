"""Marginal covariances of landmarks, with a way out when the graph does not determine them all."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import skew
from objslam.graph.factors.priors import point_prior
from objslam.graph.optimizers import indeterminate
from objslam.graph.variables import L0, X0

HELD = 1.0
"""The standard deviation (m) of a prior that holds landmarks which nothing else does. A landmark that only this prior holds
is not determined; larger holds less, and lets the linear system become indeterminate."""


def marginal_covariances(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints, ledger: Ledger) -> Floats:
    """Covariances (n, 3, 3), m^2, of the landmarks (n,) at `values`.

    When the linear system is indeterminate, every landmark is held by a prior of 1 m for this computation; those whose
    uncertainty then comes from that prior get NaN, the others keep theirs, and the ledger is warned.
    """
    try:
        return _marginals(graph, values, landmarks)
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; objects that nothing holds are left unresolved")
    held = graph.clone()
    for j in landmarks.tolist():
        held.push_back(point_prior(j, values.atPoint3(L0 + j), HELD))
    try:
        covariance = _marginals(held, values, landmarks)
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; no object has one")
        return np.full((len(landmarks), 3, 3), np.nan)
    held_by_more = np.linalg.eigvalsh(covariance)[:, -1] <= (0.5 * HELD) ** 2
    without_prior = np.full_like(covariance, np.nan)
    without_prior[held_by_more] = np.linalg.inv(np.linalg.inv(covariance[held_by_more]) - np.eye(3) / HELD**2)
    return without_prior


def seen_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints, witnesses: Ints, ledger: Ledger
) -> Floats:
    """Covariances (n, 3, 3), m^2, of landmarks (n,) in the frame of one camera each, keyframes (n,), at `values`.

    What the graph does not know of the camera's own pose is not in them: far from where a map from odometry begins, that is
    nearly all of a landmark's own covariance. NaN, and the ledger is warned, where the linear system is indeterminate.
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
    """Covariance (3, 3), m^2, of L(j) at a point (3,) in the frame of X(k) at map_T_camera (4, 4), of their joint one."""
    x, landmark = X0 + k, L0 + j
    to_point = map_T_camera[:3, :3].T
    seen = to_point @ (point - map_T_camera[:3, 3])
    to_pose = np.hstack([skew(seen), -np.eye(3)])
    cross = to_pose @ joint.at(x, landmark) @ to_point.T
    spread = to_pose @ joint.at(x, x) @ to_pose.T + to_point @ joint.at(landmark, landmark) @ to_point.T
    return np.asarray(spread + cross + cross.T)


def largest_sigma(covariances: Floats) -> Floats:
    """The largest standard deviation (n,) m in any direction of covariances (n, 3, 3); NaN where they are."""
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
