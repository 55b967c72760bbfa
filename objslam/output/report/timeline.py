"""Draw timelines, which show when an object was seen, as two paths of an SVG drawing."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats

_BINS = 150  # The number of bars of a timeline. A larger number shows shorter sightings, and makes the page larger.
WIDTH, HEIGHT = 150.0, 12.0  # The area of the bars, in units of the drawing.


@dataclass(frozen=True)
class Timeline:
    """The bars of a timeline: outlines of the used and of the rejected rays, as SVG path data."""

    used: str
    rejected: str


def timeline(stamps: Floats, used: Bools, begin: float, end: float) -> Timeline:
    """Return the timeline of an object's rays at stamps (M,), s.

    used: (M,) whether a ray is used. begin, end: the stamps of the first and the last ray of the result, s. The height of a
    bar grows with the square root of the number of its rays. Rejected rays are drawn above the used rays.
    """
    place = (stamps - begin) / max(end - begin, 1e-9)
    index = np.clip((place * _BINS).astype(int), 0, _BINS - 1)
    kept, out = (np.bincount(index[mask], minlength=_BINS) for mask in (used, ~used))
    both = kept + out
    height = HEIGHT * np.sqrt(both / max(int(both.max(initial=1)), 1))
    share = np.divide(kept, both, out=np.zeros(_BINS), where=both > 0)
    return Timeline(_bars(np.full(_BINS, HEIGHT), height * share), _bars(HEIGHT - height * share, height * (1 - share)))


def _bars(bottom: Floats, height: Floats) -> str:
    """Return bars as SVG path data. bottom: (_BINS,) y of the lower edges, positive down. height: (_BINS,) of the bars."""
    rows = np.flatnonzero(height > 0).tolist()
    return "".join(f"M{i} {bottom[i]:.1f}v{-height[i]:.1f}h1v{height[i]:.1f}z" for i in rows)
