"""Timelines: when an object was seen, as two paths of an SVG drawing."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats

_BINS = 150  # The number of bars of a timeline. Larger shows shorter sightings, and makes the page larger.
WIDTH, HEIGHT = 150.0, 12.0  # The area of the bars, in units of the drawing.


@dataclass(frozen=True)
class Timeline:
    """The bars of a timeline: outlines of the used and of the rejected rays, as SVG path data."""

    used: str
    rejected: str


def timeline(stamps: Floats, used: Bools, begin: float, end: float) -> Timeline:
    """Return the timeline of rays at stamps (M,), s, between the first and the last stamp of the drive.

    The height of a bar grows with the root of the number of its rays. Rejected rays stand on top of the used rays.
    """
    place = (stamps - begin) / max(end - begin, 1e-9)
    index = np.clip((place * _BINS).astype(int), 0, _BINS - 1)
    kept, out = (np.bincount(index[mask], minlength=_BINS) for mask in (used, ~used))
    both = kept + out
    height = HEIGHT * np.sqrt(both / max(int(both.max(initial=1)), 1))
    share = np.divide(kept, both, out=np.zeros(_BINS), where=both > 0)
    return Timeline(_bars(np.full(_BINS, HEIGHT), height * share), _bars(HEIGHT - height * share, height * (1 - share)))


def _bars(bottom: Floats, height: Floats) -> str:
    """Return a path of bars. bottom, height: (_BINS,) where each bar begins, and how far it goes up."""
    rows = np.flatnonzero(height > 0).tolist()
    return "".join(f"M{i} {bottom[i]:.1f}v{-height[i]:.1f}h1v{height[i]:.1f}z" for i in rows)
