"""Estimate small errors of the calibration at given poses: the camera rotation, clock or focal length that fits best.

The points of an `Agreement` move with the errors. Errors are added one by one. The error that explains most comes first.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import UNITS, kind
from objslam.core.types import Keyframes, Log, Rays
from objslam.frontend.known_errors import prior_sigma, shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.graph.calibration.fixed_pose_calibration import PointSystem, linearise_points
from objslam.mapping.checks.agreement import Agreement

_PRIORS = {"clock": 0.3, "yaw": 0.2, "tilt": 0.2, "roll": 0.2, "focal": 0.2, "translation": 0.3}
"""Wide prior standard deviations of the examined errors (s, rad, share, m). They bound the search."""
_HARMFUL = {"clock": 0.12, "yaw": 0.035, "tilt": 0.035, "roll": 0.035, "focal": 0.03, "x": 0.1, "y": 0.1}
"""The sizes (s, rad, share, m) above which an error causes a warning. A usual calibration has smaller errors."""
_USUAL = {"focal": 0.05, "translation": 0.1}
"""The priors (share, m) that a warning recommends for errors that the settings keep at 0. A larger prior lets a run find a
larger error."""
_KINDS = tuple(_HARMFUL)
_LEAST_GAIN = 40.0
"""The least decrease of the sum of the squared deviations by an error that counts, in units of their variance. A larger
value finds fewer errors."""
_LEAST_SHARE = 0.04
"""The least decrease of the sum of the squared deviations by an error that counts, as a share of the sum. Rays of a real log
are not independent, so a decrease that is a small share of a large sum proves nothing. A larger value finds fewer errors."""
_UNUSUAL = 4.0
"""An error is unusual if it exceeds this number of prior standard deviations. A larger number calls fewer errors unusual."""
_ROUNDS = 6
"""The number of Gauss-Newton steps after each added error. A larger number is more exact."""
_CLOCK_SIGMA = 0.05
"""The standard deviation (s) of a clock offset that was found only by trying. A larger value makes the clock less
certain."""

CAUSES = {
    "clock": "the clocks of the camera and of the poses differ",
    "yaw": "base_T_camera is turned about the vertical axis",
    "tilt": "base_T_camera is tilted up or down",
    "roll": "base_T_camera is rolled",
    "focal": "the camera matrix has another focal length, or belongs to another image size",
    "x": "base_T_camera is moved forward or back",
    "y": "base_T_camera is moved aside",
}
"""The cause that a large error of each kind indicates."""


@dataclass(frozen=True)
class SmallErrors:
    """Errors that explain the residuals. names: the names of P errors. values, sigma: (P,) their values and standard
    deviations, in the units of `core.calibration`.

    errors: all examined errors, as parameters of the measurements. estimated: the names of the errors that the run itself
    estimates.
    """

    errors: SharedErrors
    names: tuple[str, ...]
    values: Floats
    sigma: Floats
    estimated: frozenset[str] = frozenset()

    @property
    def harmful(self) -> tuple[str, ...]:
        """The names of the errors that need a warning: large errors that the run does not estimate."""
        named = zip(self.names, self.values.tolist(), strict=True)
        return tuple(n for n, v in named if abs(v) > _HARMFUL[kind(n)] and n not in self.estimated)

    def corrected(self, log: Log, only: Collection[str] | None = None) -> Log:
        """Return a log without the errors. only: the names of the errors to remove, None for all."""
        every = np.zeros(len(self.errors.names))
        for name, value in zip(self.names, self.values.tolist(), strict=True):
            if only is None or name in only:
                every[self.errors.names.index(name)] = value
        return shared(log, self.errors.keyframes, self.errors.rays, self.errors.settings).corrected_log(every)

    def in_words(self) -> str:
        """Return the harmful errors with their sizes."""
        return self._words_of(self.harmful)

    def unusual(self, settings: Settings) -> str:
        """Return errors with their sizes, in words: errors that the run estimates and that are far larger than their priors.
        "" if there are none."""
        found = zip(self.names, self.values.tolist(), strict=True)
        far = (n for n, v in found if n in self.estimated and abs(v) > _UNUSUAL * prior_sigma(n, settings))
        return self._words_of(tuple(far))

    def _words_of(self, names: Collection[str]) -> str:
        parts = []
        for name, value, sigma in zip(self.names, self.values.tolist(), self.sigma.tolist(), strict=True):
            if name in names:
                unit = UNITS.get(kind(name), "share")
                if unit == "rad":
                    value, sigma, unit = np.degrees(value), np.degrees(sigma), "deg"
                elif unit == "share":
                    value, sigma, unit = 100 * value, 100 * sigma, "%"
                parts.append(f"{name} {value:+.2f} +- {sigma:.2f} {unit}")
        return ", ".join(parts)

    def remedy(self, settings: Settings) -> str:
        """Return the options with which a run estimates the harmful errors. settings: the settings of a run without these
        options."""
        held = [kind(name) for name in self.harmful if prior_sigma(name, settings) == 0]
        given = dict.fromkeys("translation" if what in ("x", "y") else what for what in held)
        options = ["calibration.use=true", *(f"calibration.{what}={_USUAL[what]}" for what in given if what in _USUAL)]
        return " ".join(f"--set {option}" for option in options)

    def causes(self) -> str:
        """Return the probable causes."""
        return "; ".join(dict.fromkeys(CAUSES[kind(name)] for name in self.harmful))


def shared(
    log: Log, keyframes: Keyframes, rays: Rays, settings: Settings, priors: Mapping[str, float] = _PRIORS
) -> SharedErrors:
    """Return the examined errors, as parameters of the measurements. priors: standard deviations (s, rad, share, m)."""
    fixed = dict.fromkeys(
        (
            *("scale", "lateral_scale", "turn_scale", "turn_bias", "turn_per_m", "turn_slip"),
            *("range_scale", "range_offset", "tag_scale", "centre"),
        ),
        0.0,
    )
    of = settings.calibration.model_copy(update={**fixed, **priors, "use": True, "file": None})
    wide = settings.model_copy(update={"calibration": of, "mode": "joint"})
    found = shared_errors(log, keyframes, rays, wide)
    assert found is not None  # Every log has a camera, and every camera has a clock.
    return found


def find_small_errors(log: Log, found: Agreement, settings: Settings, noise: tuple[float, float]) -> SmallErrors | None:
    """Return the errors that explain the residuals of the fitting rays. None if there are none, or too few rays.

    noise: the standard deviations of the poses (rad, m).
    """
    held = found.point >= 0
    if held.sum() < 10 * len(_KINDS):
        return None
    errors = shared(log, found.keyframes, found.rays, settings)
    wanted = np.array([i for i, name in enumerate(errors.names) if kind(name) in _KINDS])
    number, owner = np.unique(found.point[held], return_inverse=True)
    points = found.points[number]
    theta = np.zeros(len(errors.names))
    chosen: list[int] = []
    for _ in range(2 * len(_KINDS)):
        system = linearise_points(errors, theta, points, owner, held, noise, trusted=False)
        gains = np.zeros(len(theta))
        for i in wanted.tolist():
            if i not in chosen:
                gains[i] = _gain(system, [*chosen, i]) - _gain(system, chosen)
        best = int(gains.argmax())
        if gains[best] < max(_LEAST_GAIN * system.variance, _LEAST_SHARE * system.cost):
            break
        chosen.append(best)
        for _ in range(_ROUNDS):
            system = linearise_points(errors, theta, points, owner, held, noise, trusted=False)
            step, moved = _step(system, chosen)
            theta[chosen] = np.clip(theta[chosen] + step, -errors.bounds[chosen], errors.bounds[chosen])
            points = points + moved
        if len(chosen) == len(wanted):
            break
    if not chosen:
        return None
    system = linearise_points(errors, theta, points, owner, held, noise, trusted=False)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(system.matrix[np.ix_(chosen, chosen)])) * system.variance)
    return SmallErrors(errors, tuple(errors.names[i] for i in chosen), theta[chosen], sigma)


def with_clock(errors: SmallErrors | None, offset: float, log: Log, found: Agreement, settings: Settings) -> SmallErrors:
    """Return the errors of a log: `errors`, with an offset (s) added to each clock.

    errors: the errors of a copy of the log whose frames have stamps that are later by the offset. If they are None, the
    clocks of the cameras are the only returned errors.
    """
    own = shared(log, found.keyframes, found.rays, settings)
    values = dict.fromkeys((name for name in own.names if kind(name) == "clock"), offset)
    sigmas = dict.fromkeys(values, _CLOCK_SIGMA)
    if errors is not None:
        for name, value, sigma in zip(errors.names, errors.values.tolist(), errors.sigma.tolist(), strict=True):
            values[name], sigmas[name] = values.get(name, 0.0) + value, sigma
    return SmallErrors(own, tuple(values), np.array(list(values.values())), np.array(list(sigmas.values())))


def _gain(system: PointSystem, which: list[int]) -> float:
    """Return by how much the errors `which` can lower the cost."""
    if not which:
        return 0.0
    at = np.ix_(which, which)
    return float(system.vector[which] @ np.linalg.lstsq(system.matrix[at], system.vector[which], rcond=1e-9)[0])


def _step(system: PointSystem, which: list[int]) -> tuple[Floats, Floats]:
    """Return the step (P,) of the errors `which`, and the step of the points (N, 3)."""
    step = np.linalg.lstsq(system.matrix[np.ix_(which, which)], -system.vector[which], rcond=1e-9)[0]
    return np.asarray(step), np.asarray(system.own + system.back[:, :, which] @ step)
