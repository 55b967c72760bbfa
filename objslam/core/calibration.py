"""Errors that all measurements of a robot share: what they are called, and what a solve found of them."""

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


class CalibratedMeasurements(Protocol):
    """What a log measured, as a function of the shared errors that are taken out of it."""

    @property
    def names(self) -> tuple[str, ...]:
        """The P parameters."""

    @property
    def prior(self) -> Floats:
        """(P,) standard deviations of the parameters before the solve."""

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
