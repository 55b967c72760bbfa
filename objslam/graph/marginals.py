"""Marginal covariances of landmarks, with a way out when the graph does not determine them all."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.graph.factors import l_key
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


def _marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, landmarks: Ints) -> Floats:
    marginals = gtsam.Marginals(graph, values)
    covariance = np.array([marginals.marginalCovariance(l_key(j)) for j in landmarks.tolist()]).reshape(-1, 3, 3)
    if not np.isfinite(covariance).all():
        raise RuntimeError("a marginal covariance is not finite")
    return covariance
