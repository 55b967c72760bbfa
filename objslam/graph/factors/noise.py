"""Make noise models from standard deviations and a loss. The loss limits the influence of outliers."""

from collections.abc import Sequence
from functools import lru_cache

import gtsam
import numpy as np

from objslam.config import Loss
from objslam.core.arrays import Floats
from objslam.core.statistics import CAUCHY_K, HUBER_K

Noise = Sequence[gtsam.noiseModel.Base]
L1_METRES = 1e-6
"""The distance (m) below which the loss `l1` is quadratic, so that it has a derivative at 0. A larger distance is smoother
and less like a norm. This distance is far below the resolution of a map."""


def robust(loss: Loss, sigmas: Floats, dimension: int, l1_kink: float = L1_METRES) -> list[gtsam.noiseModel.Base]:
    """Return one noise model for each of the sigmas (R,). Sigmas are rounded to three digits, so many rays share one model.

    The loss acts on the norm of the whitened residual. The loss `l1` is a Huber loss of slope 1 / sigma that is quadratic
    below `l1_kink` (unit of the residual). For the loss `gnc`, the model is Gaussian, and the optimiser applies the loss.
    """
    digits = 10.0 ** (np.floor(np.log10(sigmas)) - 2)
    return [_model(loss, sigma, dimension, l1_kink) for sigma in (np.round(sigmas / digits) * digits).tolist()]


def huber(model: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """Wrap a noise model in Huber's loss."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K), model)


@lru_cache(maxsize=4096)
def _model(loss: Loss, sigma: float, dimension: int, l1_kink: float) -> gtsam.noiseModel.Base:
    estimators, wrap = gtsam.noiseModel.mEstimator, gtsam.noiseModel.Robust.Create
    if loss == "l1":  # A model with sigma s and constant k has slope k / s = 1 / sigma and kink k * s = l1_kink.
        whitened = gtsam.noiseModel.Isotropic.Sigma(dimension, np.sqrt(sigma * l1_kink))
        return wrap(estimators.Huber.Create(np.sqrt(l1_kink / sigma)), whitened)
    model = gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)
    if loss == "huber":
        return huber(model)
    if loss == "cauchy":
        return wrap(estimators.Cauchy.Create(CAUCHY_K), model)
    return model
