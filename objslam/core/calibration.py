"""Errors that all measurements of a robot share: what they are called, and what a solve found of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.types import Keyframes, Rays

OBSERVABLE = 0.8
"""The largest standard deviation of an observable parameter, as a share of its prior's; larger calls more parameters
observable. Chosen so that the log has told at least as much as half of what the prior said."""
TRADED_OFF = 0.9
"""The correlation from which on two parameters are said to trade off; larger says so more rarely."""

UNITS = {"clock": "s", "turn_bias": "rad/s", "yaw": "rad", "tilt": "rad", "roll": "rad", "x": "m", "y": "m", "z": "m"}
"""The unit of each kind of parameter; the others are shares."""


def kind(name: str) -> str:
    """Return what a parameter is, without the camera that it belongs to: the part of its name after the last dot."""
    return name.rpartition(".")[2]


@dataclass(frozen=True)
class Calibration:
    """The estimate of the shared errors: measurements with these values taken out agree best.

    names: P names, as `odometry.scale` or `CAMERA.clock`. values: (P,) in the unit of each. covariance: (P, P).
    prior: (P,) standard deviations before the solve; their mean is 0.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    prior: Floats

    @property
    def sigma(self) -> Floats:
        """(P,) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    def traded_off(self) -> list[tuple[str, str]]:
        """Return the pairs of parameters that the log cannot tell apart: their errors are highly correlated."""
        correlation = self.covariance / np.outer(self.sigma, self.sigma)
        first, second = np.nonzero(np.triu(np.abs(correlation) > TRADED_OFF, 1))
        return [(self.names[i], self.names[j]) for i, j in zip(first, second, strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Return what summary.json holds: each parameter with value, sigma, prior, unit and whether the log tells it."""
        sigma = self.sigma
        parameters = {
            name: {
                "value": float(self.values[i]),
                "sigma": float(sigma[i]),
                "prior_sigma": float(self.prior[i]),
                "unit": UNITS.get(kind(name), "share"),
                "observable": bool(sigma[i] <= OBSERVABLE * self.prior[i]),
            }
            for i, name in enumerate(self.names)
        }
        return {"parameters": parameters, "traded_off": [list(pair) for pair in self.traded_off()]}


def combine(calibrations: Sequence[Calibration]) -> Calibration:
    """Combine calibrations of one robot from several logs: their information adds up, and the prior counts once.

    A parameter that only some of the logs have is taken from these logs.
    """
    names = tuple(dict.fromkeys(name for one in calibrations for name in one.names))
    sigma = {name: prior for one in calibrations for name, prior in zip(one.names, one.prior, strict=True)}
    prior = np.array([sigma[name] for name in names])
    information, vector = np.diag(prior**-2.0), np.zeros(len(names))
    for one in calibrations:
        at = np.array([names.index(name) for name in one.names])
        own = np.linalg.inv(one.covariance) - np.diag(one.prior**-2.0)
        size, axes = np.linalg.eigh((own + own.T) / 2)
        own = (axes * np.maximum(size, 0.0)) @ axes.T  # rounding must not take information away
        information[np.ix_(at, at)] += own
        vector[at] += np.linalg.inv(one.covariance) @ one.values
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Calibration(names, covariance @ vector, covariance, prior)


class CalibratedMeasurements(Protocol):
    """What a log measured, as a function of the shared errors that are taken out of it."""

    @property
    def names(self) -> tuple[str, ...]:
        """The P parameters."""

    @property
    def mean(self) -> Floats:
        """(P,) expected values of the parameters before the solve."""

    @property
    def prior(self) -> Floats:
        """(P, P) covariance of the parameters before the solve."""

    @property
    def steps(self) -> Floats:
        """(P,) steps of the parameters over which derivatives are taken."""

    @property
    def bounds(self) -> Floats:
        """(P,) the largest absolute values of the parameters."""

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return the measurements with the errors (P,) taken out, and the settings of their noise.

        drift: whether the keyframes' drift is needed; without it the call is quicker and `Keyframes.drift` is not current.
        """
