"""The drift of each robot's calibration over the days, as one curve for each robot and each shared error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.fleet.driver import Mapped

_MOST = 24
"""The maximum number of curves on a page. With a larger number, the page also shows smaller changes."""


@dataclass(frozen=True)
class Drift:
    """The weighted mean of one shared error of one robot on each of D days.

    name: the name of the shared error. days: the names of the days, in order. value, sigma: (D,) the mean and its standard
    deviation, in `unit`. change: the value of the last day minus the value of the first day, in standard deviations of this
    difference.
    """

    robot: str
    name: str
    unit: str
    days: tuple[str, ...]
    value: Floats
    sigma: Floats
    change: float

    def curve(self, width: float, height: float) -> tuple[str, list[tuple[float, float, float, str]], float, float]:
        """Return the curve for an SVG drawing of the given width and height, in units of the drawing.

        The values are the path data, the points, and the lower and the upper end of the vertical axis in `unit`. A point has
        x, y, half the length of its error bar, and its text.
        """
        low, high = float((self.value - self.sigma).min()), float((self.value + self.sigma).max())
        span = max(high - low, 1e-12)
        x = np.linspace(0, width, len(self.days)) if len(self.days) > 1 else np.array([width / 2])
        y = height - (self.value - low) / span * height
        bar = self.sigma / span * height
        texts = (
            f"{day}: {v:.4g} ± {s:.2g} {self.unit}" for day, v, s in zip(self.days, self.value, self.sigma, strict=True)
        )
        points = list(zip(x.tolist(), y.tolist(), bar.tolist(), texts, strict=True))
        path = "".join(f"{'L' if k else 'M'}{a:.2f} {b:.2f}" for k, (a, b, _, _) in enumerate(points))
        return path, points, low, high


def drifts(mapped: Sequence[Mapped]) -> list[Drift]:
    """Return at most `_MOST` curves. The curve with the largest change comes first.

    There is one curve for each pair of a named robot and an error that the robot's logs determine on at least two days. The
    value of a day is the mean over the sessions of this day, weighted by the inverse variances.
    """
    found: dict[tuple[str, str, str], dict[str, list[tuple[float, float]]]] = {}
    for one in mapped:
        for parameter in one.calibration if one.place.robot else ():
            if parameter.known and parameter.sigma > 0:
                days = found.setdefault((one.place.robot, parameter.name, parameter.unit), {})
                days.setdefault(one.day, []).append((parameter.value, parameter.sigma))
    curves = []
    for (robot, name, unit), days in found.items():
        if len(days) < 2:
            continue
        order = sorted(days)
        weights = [np.array([sigma**-2 for _, sigma in days[day]]) for day in order]
        value = np.array([np.average([v for v, _ in days[day]], weights=w) for day, w in zip(order, weights, strict=True)])
        sigma = np.array([w.sum() ** -0.5 for w in weights])
        change = float((value[-1] - value[0]) / np.hypot(sigma[0], sigma[-1]))
        curves.append(Drift(robot, name, unit, tuple(order), value, sigma, change))
    curves.sort(key=lambda one: (-abs(one.change), one.robot, one.name))
    return curves[:_MOST]
