"""Histograms of residuals, as bars that a template draws in SVG."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.scene import REJECTED_BELOW
from objslam.types import Floats

WIDTH, HEIGHT = 100.0, 40.0
"""Of the area in which the bars stand, in units of their own."""
_STEPS = np.array([1.0, 2.0, 2.5, 5.0, 10.0])


@dataclass(frozen=True)
class Bar:
    """One bin: where it stands (x, width), the heights of its used and its rejected rays, and what it says."""

    x: float
    width: float
    used: float
    rejected: float
    text: str


@dataclass(frozen=True)
class Histogram:
    """Bars, ticks below them and beside them (place, text), the rays in the highest bar, and those beyond the axis.

    The last bar takes those beyond the axis too.
    """

    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]
    counts: tuple[tuple[float, str], ...]
    highest: int
    beyond: int


def histogram(residual: Floats, weight: Floats, bins: int, top: float | None = None) -> Histogram | None:
    """Of residuals (R,), deg, which are used or rejected by their weight (R,); None without any.

    top: deg, the end of the axis; from the used residuals if not given.
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
    """Two to five round numbers of rays from 0 to the highest bar, and how high they are."""
    power = 10.0 ** np.floor(np.log10(highest))
    step = max(1, next(int(power * s) for s in (5.0, 2.0, 1.0, 0.5, 0.2) if highest >= 2 * power * s))
    return tuple((HEIGHT * n / highest, f"{n}") for n in range(0, highest + 1, step))


def axis_end(residual: Floats) -> float:
    """A round number (deg) that nearly all residuals (R,) lie below."""
    most = max(float(np.quantile(residual, 0.98)), 1e-6)
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * _STEPS[np.searchsorted(_STEPS, most / power - 1e-9)])
