"""Histograms of residuals. The page's template draws their bars in SVG."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.output.plot.style import REJECTED_BELOW

WIDTH, HEIGHT = 100.0, 40.0  # The size of the area of the bars, in units of the SVG drawing.
_ENDS = np.array([1.0, 2.0, 2.5, 5.0, 10.0])  # An axis ends at one of these numbers times a power of ten.


@dataclass(frozen=True)
class Bar:
    """One bin of a histogram. Lengths are in units of the SVG drawing."""

    x: float
    width: float
    used: float  # The height of the part for used rays.
    rejected: float  # The height of the part for rejected rays, on top of the used rays.
    text: str  # The tooltip.


@dataclass(frozen=True)
class Histogram:
    """A histogram with its axes, in units of the SVG drawing. The last bar includes the rays beyond the end of the axis."""

    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]  # Position and text of each tick below the bars.
    counts: tuple[tuple[float, str], ...]  # Height and text of each tick beside the bars.
    highest: int  # The number of rays in the highest bar.
    beyond: int  # The number of rays beyond the end of the axis.


def histogram(residual: Floats, weight: Floats, bins: int, top: float | None = None) -> Histogram | None:
    """Return a histogram of residuals (R,), deg, of used and of rejected rays, or None if no residual is finite.

    Args:
        weight: (R,) robust weights. A ray with a weight below `REJECTED_BELOW` is rejected.
        bins: the number of bars.
        top: the end of the axis, deg. The default is the `axis_end` of the used rays, or of all rays if none is used.
    """
    known = np.isfinite(residual)
    residual, used = residual[known], weight[known] >= REJECTED_BELOW
    if not len(residual):
        return None
    edge = top or axis_end(residual[used] if used.any() else residual)
    index = np.minimum((residual / edge * bins).astype(int), bins - 1)
    counts = [np.bincount(index[mask], minlength=bins) for mask in (used, ~used)]
    highest = int((counts[0] + counts[1]).max())
    step, scale = WIDTH / bins, HEIGHT / highest
    bars = []
    for i, (of, out) in enumerate(zip(*(c.tolist() for c in counts), strict=True)):
        low, high = edge * i / bins, edge * (i + 1) / bins
        place = f"{low:.3g} to {high:.3g} deg" if i < bins - 1 else f"more than {low:.3g} deg"
        text = f"{place}: {of} used" + (f", {out} rejected" if out else "")
        bars.append(Bar(i * step, step, of * scale, out * scale, text))
    ticks = tuple((WIDTH * share, f"{edge * share:.3g}") for share in (0.0, 0.5, 1.0))
    power = 10.0 ** np.floor(np.log10(highest))
    rays = max(1, next(int(power * s) for s in (5.0, 2.0, 1.0, 0.5, 0.2) if highest >= 2 * power * s))
    heights = tuple((HEIGHT * n / highest, f"{n}") for n in range(0, highest + 1, rays))
    return Histogram(tuple(bars), ticks, heights, highest, int((residual > edge).sum()))


def axis_end(residual: Floats) -> float:
    """Return a round number at or above the 98 % quantile of residuals (R,), in the unit of the residuals."""
    most = max(float(np.quantile(residual, 0.98)), 1e-6)
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * _ENDS[np.searchsorted(_ENDS, most / power - 1e-9)])
