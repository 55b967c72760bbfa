"""Make charts of the residuals against turn rate, speed and place in the image. They reveal shared errors.

The template of the page draws the charts in SVG.
"""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.io.rays_parquet import RaysTable
from objslam.output.plot.style import REJECTED_BELOW
from objslam.output.report.charts import HEIGHT, WIDTH, axis_end

_BINS = 12
"""The largest number of points of a curve. Each point is the median of the same number of rays. More points show more detail
and more noise."""
_FEWEST = 15
"""The least number of rays for a point. More rays make curves smoother. With 15, the error of a median is about 20 %."""
_HONEST = float(np.sqrt(2 * np.log(2)))
"""The expected median residual in standard deviations along one axis. The error has two axes, so the expected value is the
median of the Rayleigh distribution. If the median residual is larger, the noise is larger than in the settings."""


@dataclass(frozen=True)
class Point:
    """A point of a curve, in units of the SVG drawing, and its tooltip."""

    x: float
    y: float
    text: str


@dataclass(frozen=True)
class Trend:
    """A chart with curves of the median residual.

    curves: the name and the points of each curve. The names are "before" and "after", for the correction of shared errors.
    The curve "before" is missing if it is unknown. below, beside: position and text of each tick below and beside the chart.
    level: the height of `_HONEST`, None for a chart in degrees.
    """

    title: str
    unit: str
    curves: tuple[tuple[str, tuple[Point, ...]], ...]
    below: tuple[tuple[float, str], ...]
    beside: tuple[tuple[float, str], ...]
    level: float | None


def trends(rays: RaysTable) -> list[Trend]:
    """Return the charts of the used rays, in degrees and in standard deviations, against turn rate, speed and place in the
    image.

    A quantity that does not vary or has too few rays has no chart.
    """
    used = (rays.weight >= REJECTED_BELOW) & np.isfinite(rays.residual)
    against = (
        ("turn rate, °/s (left is positive)", np.degrees(rays.turn_rate[used])),
        ("speed, m/s", rays.speed[used]),
        ("place in the image, 0 left to 1 right", rays.image[used, 0]),
        ("place in the image, 0 top to 1 bottom", rays.image[used, 1]),
    )
    units = (("°", np.degrees(np.ones(used.sum()))), ("sigmas", 1 / rays.sigma[used]))
    both = (("before", rays.residual_before[used]), ("after", rays.residual[used]))
    charts = [
        _trend(title, x, {name: values * factor for name, values in both}, unit)
        for title, x in against
        for unit, factor in units
    ]
    return [chart for chart in charts if chart is not None]


def _trend(title: str, x: Floats, residuals: dict[str, Floats], unit: str) -> Trend | None:
    bins = min(_BINS, len(x) // _FEWEST)
    if bins < 2:
        return None
    parts = np.array_split(np.argsort(x, kind="stable"), bins)
    at = np.array([np.median(x[part]) for part in parts])
    low, high = float(at[0]), float(at[-1])
    if high - low <= 1e-6 * max(abs(low), abs(high)) or high - low < 1e-3:
        return None
    medians = {
        name: np.array([np.median(values[part]) for part in parts])
        for name, values in residuals.items()
        if np.isfinite(values).all()
    }
    honest = _HONEST if unit == "sigmas" else 0.0
    top = axis_end(np.array([max(honest, *(float(m.max()) for m in medians.values()))]))
    curves = tuple(
        (
            name,
            tuple(
                Point(
                    WIDTH * (a - low) / (high - low),
                    HEIGHT * m / top,
                    f"{name}: median {m:.3g} {unit} of {len(part)} rays at {a:.3g}",
                )
                for a, m, part in zip(at.tolist(), median.tolist(), parts, strict=True)
            ),
        )
        for name, median in medians.items()
    )
    return Trend(
        title,
        unit,
        curves,
        tuple((WIDTH * (value - low) / (high - low), f"{value:g}") for value in _round_ticks(low, high)),
        tuple((HEIGHT * share, f"{top * share:.3g}") for share in (0.0, 0.5, 1.0)),
        HEIGHT * honest / top if honest else None,
    )


def _round_ticks(low: float, high: float) -> list[float]:
    """Return two to five round numbers from low to high."""
    power = 10.0 ** np.floor(np.log10(high - low))
    steps = [share * power for share in (0.2, 0.5, 1.0, 2.0)]
    step = next(step for step in steps if np.floor(high / step) - np.ceil(low / step) <= 4)
    return [round(float(n * step), 9) + 0.0 for n in np.arange(np.ceil(low / step), np.floor(high / step) + 1)]
