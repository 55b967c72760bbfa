"""Shared errors: errors that all measurements of a robot have in common, such as a wrong scale of its odometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.noise import NoiseFactors
from objslam.core.types import Keyframes, Rays

OBSERVABLE = 0.8
"""The largest standard deviation of an observable parameter, as a share of the standard deviation of its prior. At 0.8, the
log gives about half as much information as the prior. With a larger share, more parameters count as observable."""
TRADED_OFF = 0.9
"""The absolute correlation above which two parameters trade off. The log can hardly separate the effects of such parameters.
With a larger value, fewer pairs trade off."""

SCALES = ("scale", "lateral_scale", "turn_scale", "range_scale", "tag_scale", "focal")
"""The kinds of parameters that are shares. The correction multiplies a measurement by 1 + the share."""
AXES = ("roll", "tilt", "yaw")
"""The rotations of a camera on the robot, about the axes x, y and z of base."""
LENS = ("focal", "cx", "cy")
"""The errors of a camera matrix. The focal length is too short by the share `focal`. The image centre is too far left by cx
and too far up by cy, both as shares of the focal length."""
OF_PLACES = ("tag_scale", "surface")
"""The kinds of parameters that belong to a place, not to a robot. The calibration of a robot has none of them."""
MOST_SCALE = 0.5
"""The largest absolute value of a share. A larger bound lets a solve shrink lengths towards zero. An error of more than half
means a wrong unit, and a calibration should not hide a wrong unit."""

UNITS = {
    "clock": "s",
    "turn_bias": "rad/s",
    "turn_per_m": "rad/m",
    "turn_slip": "m/rad",
    "range_offset": "m",
    "yaw": "rad",
    "tilt": "rad",
    "roll": "rad",
    "x": "m",
    "y": "m",
    "z": "m",
}
"""The unit of each kind of parameter. A kind that is not in this table is a share without a unit."""


def kind(name: str) -> str:
    """Return the kind of a parameter: the part of its name after the last dot, without the camera."""
    return name.rpartition(".")[2]


@dataclass(frozen=True)
class Calibration:
    """The estimate of the shared errors. Measurements that are corrected by these values agree best.

    names: P names, such as `odometry.scale` or `CAMERA.clock`. values: (P,) in the unit of each. covariance: (P, P) after
    the solve. prior: (P,) standard deviations before the solve. prior_mean: (P,) values expected before the solve, None if
    all are 0. prior_covariance: (P, P) before the solve, None if the parameters were independent. prior_factor: (P,) the
    factors by which the priors were widened for `covariance`, because the values are far from the priors. None if no prior
    was widened.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    prior: Floats
    prior_mean: Floats | None = None
    prior_covariance: Floats | None = None
    prior_factor: Floats | None = None

    @property
    def sigma(self) -> Floats:
        """(P,) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def root(self) -> Floats:
        """(P, P) a matrix whose product with its own transpose is the covariance."""
        size, axes = np.linalg.eigh(self.covariance)
        return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))

    @property
    def expected(self) -> Floats:
        """(P,) values that were expected before the solve."""
        return np.zeros(len(self.names)) if self.prior_mean is None else self.prior_mean

    @property
    def before(self) -> Floats:
        """(P, P) covariance before the solve."""
        return np.diag(self.prior**2) if self.prior_covariance is None else self.prior_covariance

    def traded_off(self) -> list[tuple[str, str]]:
        """Return the pairs of parameters whose errors are so highly correlated that the log cannot separate the two."""
        correlation = self.covariance / np.outer(self.sigma, self.sigma)
        first, second = np.nonzero(np.triu(np.abs(correlation) > TRADED_OFF, 1))
        return [(self.names[i], self.names[j]) for i, j in zip(first, second, strict=True)]

    def of_robot(self) -> Self:
        """Return the marginal of the parameters of the robot, which is without the parameters of the place (`OF_PLACES`)."""
        own = np.flatnonzero([name not in OF_PLACES for name in self.names])
        square = np.ix_(own, own)
        return replace(
            self,
            names=tuple(self.names[i] for i in own),
            values=self.values[own],
            covariance=self.covariance[square],
            prior=self.prior[own],
            prior_mean=self.expected[own],
            prior_covariance=self.before[square],
            prior_factor=None if self.prior_factor is None else self.prior_factor[own],
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of summary.json. They are the parameters, the pairs that trade off, and the covariance before
        and after the solve. A parameter has its value, sigma, prior and unit, and whether it is observable.

        A later run with this file in `calibration.file` takes the values and the covariance as its prior.
        """
        sigma, expected = self.sigma, self.expected
        wider = np.ones(len(self.names)) if self.prior_factor is None else self.prior_factor
        parameters = {
            name: {
                "value": float(self.values[i]),
                "sigma": float(sigma[i]),
                "prior_mean": float(expected[i]),
                "prior_sigma": float(self.prior[i]),
                "prior_factor": float(wider[i]),
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
    """Combine calibrations of one robot from several logs. Their information adds up, and the prior counts once.

    A parameter that only some logs have is estimated from these logs. Its prior is from the first log with the parameter,
    conditional on the parameters that this log shares with earlier logs.
    """
    names = tuple(dict.fromkeys(name for one in calibrations for name in one.names))
    prior, prior_vector, told, told_vector = (np.zeros((len(names),) * axes) for axes in (2, 1, 2, 1))
    known = np.zeros(len(names), dtype=bool)
    for one in calibrations:
        at = np.array([names.index(name) for name in one.names])
        before = np.linalg.inv(one.before)
        own = np.linalg.inv(one.covariance) - before
        size, axes = np.linalg.eigh((own + own.T) / 2)
        own = (axes * np.maximum(size, 0.0)) @ axes.T  # Rounding errors may make information negative.
        told[np.ix_(at, at)] += own
        told_vector[at] += (own + before) @ one.values - before @ one.expected
        # Earlier logs gave the prior of the known parameters. This log adds p(new | known) = p(new, known) / p(known).
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
    """The measurements of a log. `at` corrects them for given values of the shared errors."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the P parameters."""

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
    def cameras(self) -> tuple[str, ...]:
        """The names of the cameras, in the order of `Keyframes.camera`."""

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
        """(P,) the largest absolute values that the parameters may take."""

    @property
    def noise(self) -> NoiseFactors:
        """The noise of the measurements, as factors on the nominal noise."""

    @property
    def odometry_stamps(self) -> Floats:
        """(n,) s, the stamps of the odometry, empty without odometry."""

    @property
    def unknown_noise(self) -> frozenset[str]:
        """The kinds of noise that are estimated: any of `rays`, `ranges`, `odometry` and `localization`."""

    @property
    def unknown_scales(self) -> frozenset[str]:
        """The scale parameters, if the log does not determine the scale of its map, else an empty set. The scale is
        undetermined if each kind of measured length has a scale parameter, and no absolute pose is measured."""

    def take(self, keyframes: Keyframes, rays: Rays) -> Self:
        """Return the same errors for other keyframes and rays of the log."""

    def with_rays(self, directions: Floats, ranges: Floats, values: Floats) -> Self:
        """Return the same measurements with other rays. At values (P,), `at` then returns these unit directions (R, 3) and
        ranges (R,), m."""

    def with_noise(self, noise: NoiseFactors) -> Self:
        """Return the same measurements with other noise."""

    def drift_components(self, values: Floats) -> list[tuple[Keyframes, Settings]]:
        """Return four pairs of keyframes and settings that split the noise of motions into four components.

        The components are the nominal odometry noise along the path, across it and in turning, and the noise of `planar` in
        the settings. values: (P,) the corrected errors.
        """

    def at(self, values: Floats, drift: bool = True) -> tuple[Keyframes, Rays, Settings]:
        """Return the measurements corrected by the errors (P,), and the settings of their noise.

        drift: whether `Keyframes.drift` is needed. If not, the call is quicker, and the drift is not corrected.
        """

    def rays_in_map(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return origins (M, R, 3), m, and unit directions (M, R, 3) in map, and noise (M, R), rad, of the rays of `at`.

        values: (M, P) the errors. One call for many values takes far less time than a call of `at` for each.
        """


def expected_errors(errors: CalibratedMeasurements) -> Calibration:
    """Return the shared errors with the values and the covariance that they have before a solve."""
    return Calibration(errors.names, errors.mean, errors.prior, np.sqrt(np.diagonal(errors.prior)))
