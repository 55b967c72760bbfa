"""Histograms of residuals, as bars that a template draws in SVG."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.output.plot.style import REJECTED_BELOW

WIDTH, HEIGHT = 100.0, 40.0  # The size of the area in which the bars stand, in units of the drawing.
_ENDS = np.array([1.0, 2.0, 2.5, 5.0, 10.0])  # The round numbers, times a power of ten, at which an axis may end.


@dataclass(frozen=True)
class Bar:
    """One bin."""

    x: float
    width: float
    used: float  # The height of its used rays.
    rejected: float  # The height of its rejected rays, above the others.
    text: str


@dataclass(frozen=True)
class Histogram:
    """Bars with their axes; the last bar takes the rays beyond the axis too."""

    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]  # Position and text below the bars.
    counts: tuple[tuple[float, str], ...]  # Height and text beside them.
    highest: int  # The number of rays in the highest bar.
    beyond: int  # The number of rays beyond the axis.


def histogram(residual: Floats, weight: Floats, bins: int, top: float | None = None) -> Histogram | None:
    """The histogram of residuals (R,), deg, which are used or rejected by their weight (R,); None without any.

    top: the end of the axis, deg; by default a round number that nearly all used residuals lie below.
    """
    known = np.isfinite(residual)
    residual, used = residual[known], weight[known] >= REJECTED_BELOW
    if not len(residual):
        return None
    edge = top or axis_end(residual[used] if used.any() else residual)
    index = np.minimum((residual / edge * bins).astype(int), bins - 1)
    counts = [np.bincount(index[mask], minlength=bins) for mask in (used, ~used)]
    total = counts[0] + counts[1]
    step = WIDTH / bins
    bars = []
    for i, (of, out) in enumerate(zip(*(c.tolist() for c in counts), strict=True)):
        low, high = edge * i / bins, edge * (i + 1) / bins
        place = f"{low:.3g} to {high:.3g} deg" if i < bins - 1 else f"more than {low:.3g} deg"
        text = f"{place}: {of} used" + (f", {out} rejected" if out else "")
        scale = HEIGHT / total.max()
        bars.append(Bar(i * step, step, of * scale, out * scale, text))
    ticks = tuple((WIDTH * share, f"{edge * share:.3g}") for share in (0.0, 0.5, 1.0))
    return Histogram(tuple(bars), ticks, _counts(int(total.max())), int(total.max()), int((residual > edge).sum()))


def _counts(highest: int) -> tuple[tuple[float, str], ...]:
    """Heights and texts of two to five round numbers of rays, from 0 to the highest bar."""
    power = 10.0 ** np.floor(np.log10(highest))
    step = max(1, next(int(power * s) for s in (5.0, 2.0, 1.0, 0.5, 0.2) if highest >= 2 * power * s))
    return tuple((HEIGHT * n / highest, f"{n}") for n in range(0, highest + 1, step))


def axis_end(residual: Floats) -> float:
    """A round number (deg) that nearly all residuals (R,) lie below."""
    most = max(float(np.quantile(residual, 0.98)), 1e-6)
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * _ENDS[np.searchsorted(_ENDS, most / power - 1e-9)])
