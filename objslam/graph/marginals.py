"""Marginal covariances of landmarks, with a way out when the graph does not determine them all."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.geometry import skew
from objslam.graph.factors import l_key, x_key
from objslam.graph.optimise import indeterminate
from objslam.ledger import Ledger
from objslam.types import Floats, Ints

_HELD = 1.0  # m; a landmark that only this prior holds is not determined


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
        prior = gtsam.noiseModel.Isotropic.Sigma(3, _HELD)
        held.push_back(gtsam.PriorFactorPoint3(l_key(j), values.atPoint3(l_key(j)), prior))
    try:
        covariance = _marginals(held, values, landmarks)
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; no object has one")
        return np.full((len(landmarks), 3, 3), np.nan)
    held_by_more = np.linalg.eigvalsh(covariance)[:, -1] <= (0.5 * _HELD) ** 2
    without_prior = np.full_like(covariance, np.nan)
    without_prior[held_by_more] = np.linalg.inv(np.linalg.inv(covariance[held_by_more]) - np.eye(3) / _HELD**2)
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
            x, landmark = x_key(k), l_key(j)
            joint = marginals.jointMarginalCovariance([x, landmark])
            pose = values.atPose3(x)
            turn = pose.rotation().matrix().T
            seen = turn @ (values.atPoint3(landmark) - pose.translation())
            to_pose, to_point = np.hstack([skew(seen), -np.eye(3)]), turn
            cross = to_pose @ joint.at(x, landmark) @ to_point.T
            spread = to_pose @ joint.at(x, x) @ to_pose.T + to_point @ joint.at(landmark, landmark) @ to_point.T
            covariance[i] = spread + cross + cross.T
    except RuntimeError as error:
        ledger.warn(f"covariances: {indeterminate(error).message}; objects far from the start are left unresolved")
    return covariance


def largest_sigma(covariances: Floats) -> Floats:
    """The largest standard deviation (n,) m in any direction of covariances (n, 3, 3); NaN where they are."""
    known = np.isfinite(covariances).all(axis=(1, 2))
    sigma = np.full(len(covariances), np.nan)
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[known])[:, -1], 0.0))
    return sigma


def _marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints) -> Floats:
    marginals = gtsam.Marginals(graph, values)
    covariance = np.array([marginals.marginalCovariance(l_key(j)) for j in landmarks.tolist()]).reshape(-1, 3, 3)
    if not np.isfinite(covariance).all():
        raise RuntimeError("a marginal covariance is not finite")
    return covariance
