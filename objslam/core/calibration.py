"""Errors that all measurements of a robot share: their names, and their estimate."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.noise import NoiseFactors
from objslam.core.types import Keyframes, Rays

OBSERVABLE = 0.8
"""The largest standard deviation of an observable parameter, as a share of the standard deviation of its prior. A larger
share calls more parameters observable. At this share, the log gives about half as much information as the prior."""
TRADED_OFF = 0.9
"""The absolute correlation above which two parameters trade off, so that the log hardly tells them apart. With a larger
value, fewer pairs trade off."""

SCALES = ("scale", "turn_scale", "range_scale", "focal")
"""The kinds of parameters that are shares: the correction multiplies a measurement by 1 + the share."""
MOST_SCALE = 0.5
"""The largest absolute value of a share. A larger bound lets a solve shrink lengths towards zero. Measurements that are
wrong by half have wrong units, which no calibration should hide."""

UNITS = {"clock": "s", "turn_bias": "rad/s", "yaw": "rad", "tilt": "rad", "roll": "rad", "x": "m", "y": "m", "z": "m"}
"""The unit of each kind of parameter. A kind that is not in this table is a share without a unit."""


def kind(name: str) -> str:
    """Return the kind of a parameter: the part of its name after the last dot, without the camera."""
    return name.rpartition(".")[2]


@dataclass(frozen=True)
class Calibration:
    """The estimate of the shared errors. Measurements that are corrected by these values agree best.

    names: P names, as `odometry.scale` or `CAMERA.clock`. values: (P,) in the unit of each. covariance: (P, P).
    prior: (P,) standard deviations before the solve. prior_mean: (P,) values expected before the solve, None for 0.
    prior_covariance: (P, P) before the solve, None if the parameters were independent.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    prior: Floats
    prior_mean: Floats | None = None
    prior_covariance: Floats | None = None

    @property
    def sigma(self) -> Floats:
        """(P,) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def expected(self) -> Floats:
        """(P,) values that were expected before the solve."""
        return np.zeros(len(self.names)) if self.prior_mean is None else self.prior_mean

    @property
    def before(self) -> Floats:
        """(P, P) covariance before the solve."""
        return np.diag(self.prior**2) if self.prior_covariance is None else self.prior_covariance

    def traded_off(self) -> list[tuple[str, str]]:
        """Return the pairs of parameters that the log cannot tell apart: their errors are highly correlated."""
        correlation = self.covariance / np.outer(self.sigma, self.sigma)
        first, second = np.nonzero(np.triu(np.abs(correlation) > TRADED_OFF, 1))
        return [(self.names[i], self.names[j]) for i, j in zip(first, second, strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of summary.json: each parameter with value, sigma, prior, unit and whether it is observable,
        the pairs that trade off, and the covariance before and after the solve.

        A later run with this file in `calibration.file` takes the values and the covariance as its prior.
        """
        sigma, expected = self.sigma, self.expected
        parameters = {
            name: {
                "value": float(self.values[i]),
                "sigma": float(sigma[i]),
                "prior_mean": float(expected[i]),
                "prior_sigma": float(self.prior[i]),
                "unit": UNITS.get(kind(name), "share"),
                "observable": bool(sigma[i] <= OBSERVABLE * self.prior[i]),
            }
            for i, name in enumerate(self.names)
        }
        return {
            "parameters": parameters,
            "traded_off": [list(pair) for pair in self.traded_off()],
            "covariance": self.covariance.tolist(),
            "prior_covariance": self.before.tolist(),
        }


def combine(calibrations: Sequence[Calibration]) -> Calibration:
    """Combine calibrations of one robot from several logs: their information adds up, and the prior counts once.

    A parameter that only some logs have is estimated from these logs. Its prior is from the first of these logs, conditional
    on the parameters of the logs before.
    """
    names = tuple(dict.fromkeys(name for one in calibrations for name in one.names))
    prior, prior_vector, told, told_vector = (np.zeros((len(names),) * axes) for axes in (2, 1, 2, 1))
    known = np.zeros(len(names), dtype=bool)
    for one in calibrations:
        at = np.array([names.index(name) for name in one.names])
        before = np.linalg.inv(one.before)
        own = np.linalg.inv(one.covariance) - before
        size, axes = np.linalg.eigh((own + own.T) / 2)
        own = (axes * np.maximum(size, 0.0)) @ axes.T  # rounding must not take information away
        told[np.ix_(at, at)] += own
        told_vector[at] += (own + before) @ one.values - before @ one.expected
        # The chain rule: p(new | known) = p(new, known) / p(known). All three are from the prior of this log.
        there = np.flatnonzero(known[at])
        new = before.copy()
        new[np.ix_(there, there)] -= np.linalg.inv(one.before[np.ix_(there, there)])
        prior[np.ix_(at, at)] += new
        prior_vector[at] += before @ one.expected
        prior_vector[at[there]] -= np.linalg.solve(one.before[np.ix_(there, there)], one.expected[there])
        known[at] = True
    covariance, before = (np.asarray(np.linalg.inv(part), dtype=np.float64) for part in (prior + told, prior))
    values, expected = covariance @ (prior_vector + told_vector), before @ prior_vector
    return Calibration(names, values, covariance, np.sqrt(np.diagonal(before)), expected, before)


class CalibratedMeasurements(Protocol):
    """The measurements of a log, as logged, and corrected for given values of the shared errors (`at`)."""

    @property
    def names(self) -> tuple[str, ...]:
        """The P parameters."""

    @property
    def settings(self) -> Settings:
        """The settings of the run, with the nominal noise."""

    @property
    def keyframes(self) -> Keyframes:
        """The keyframes as they were logged."""

    @property
    def rays(self) -> Rays:
        """The rays as they were measured, with the nominal noise."""

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

    @property
    def noise(self) -> NoiseFactors:
        """The noise that the measurements have."""

    @property
    def unknown_noise(self) -> frozenset[str]:
        """The kinds of noise that are estimated, of `rays`, `ranges` and `odometry`."""

    @property
    def unknown_scales(self) -> frozenset[str]:
        """The parameters that scale the measured lengths, if every kind of length has one and no absolute pose is measured.
        The log cannot determine a factor that all these lengths share. The set is empty in all other cases."""

    def take(self, keyframes: Keyframes, rays: Rays) -> Self:
        """Return the same errors for other keyframes and rays of the log."""

    def with_noise(self, noise: NoiseFactors) -> Self:
        """Return the same measurements with other noise."""

    def drift_components(self, values: Floats) -> list[tuple[Keyframes, Settings]]:
        """Return four pairs of keyframes and settings, with odometry noise only along the path, only across it, only in
        turning, and without odometry noise.

        The odometry noise is nominal. Only the last pair has the noise that is not from odometry. values: (P,) the corrected
        errors.
        """

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return the measurements corrected by the errors (P,), and the settings of their noise.

        drift: whether `Keyframes.drift` is needed. If not, the call is quicker, and the drift is not corrected.
        """
