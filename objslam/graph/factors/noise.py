"""Noise models: a standard deviation, and the loss that says how hard an outlier may pull."""

from __future__ import annotations

from functools import lru_cache

import gtsam
import numpy as np

from objslam.config import Loss
from objslam.core.arrays import Floats
from objslam.core.statistics import CAUCHY_K, HUBER_K

L1_METRES = 1e-6
"""The distance (m) below which the loss `l1` is quadratic, so that it has a derivative at 0. Chosen far below what a map
resolves; larger is smoother, and less like a norm."""


def robust(loss: Loss, sigmas: Floats, dimension: int, l1_kink: float = L1_METRES) -> list[gtsam.noiseModel.Base]:
    """Noise models, one for each of the sigmas (R,), shared where they agree to three digits.

    The loss acts on the norm of the whitened residual. `l1` is a Huber that costs 1 for each sigma, with its kink at l1_kink
    (in the residual's unit). `gnc` is left without a loss: its optimiser brings it.
    """
    digits = 10.0 ** (np.floor(np.log10(sigmas)) - 2)
    return [_model(loss, sigma, dimension, l1_kink) for sigma in (np.round(sigmas / digits) * digits).tolist()]


def huber(model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """A noise model under Huber's loss."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K), model)


@lru_cache(maxsize=4096)
def _model(loss: Loss, sigma: float, dimension: int, l1_kink: float) -> gtsam.noiseModel.Base:
    estimators, wrap = gtsam.noiseModel.mEstimator, gtsam.noiseModel.Robust.Create
    if loss == "l1":  # whitened by s, Huber's slope is k / s and its kink k * s: these are 1 / sigma and l1_kink
        whitened = gtsam.noiseModel.Isotropic.Sigma(dimension, np.sqrt(sigma * l1_kink))
        return wrap(estimators.Huber.Create(np.sqrt(l1_kink / sigma)), whitened)
    model = gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)
    if loss == "huber":
        return huber(model)
    if loss == "cauchy":
        return wrap(estimators.Cauchy.Create(CAUCHY_K), model)
    return model
