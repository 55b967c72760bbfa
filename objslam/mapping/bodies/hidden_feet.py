"""Find objects whose foot was never seen, by a comparison with the other objects of their label.

A lamp post behind parked cars shows only its upper half. If the detector missed the cars, no box shows that they hide the
lower half. The body of the post then ends where the post comes into view. The other posts end at the same height, and stand
on the ground. In a classroom, most chairs have hidden feet: desks hide all but their backs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject
from objslam.core.statistics import NORMAL_MEDIAN

_FEWEST = 4
"""The fewest objects of a label that show the height of its things. With a larger number, fewer hidden feet are found."""
_ALIKE = 0.1
"""The largest median deviation of the tops from the median top for which the things of a label are alike. It is a share of
the height of the things. With a larger share, labels of different things count as well."""
_SEEN = 0.25
"""The least share of the feet of a label that the boxes show. The quantile of all feet at this share counts as the foot of
the things. With a larger share, shorter parts of hidden feet are found to be missing. With a smaller share, a single low
foot counts."""
_SIGMAS = 3.0
"""The least distance of a hidden foot above the foot of the things, in standard deviations of their tops. A larger number
finds fewer hidden feet."""
_LEAST = 0.1
"""The least distance of a hidden foot above the foot of the things, as a share of their height. A larger share finds
fewer."""


def with_hidden_feet(objects: tuple[MapObject, ...]) -> tuple[MapObject, ...]:
    """Return the objects, with larger standard deviations of height and size where a foot may be hidden.

    Things of one label may end at the same height. If the foot of one is then higher than the lowest feet, its centre may be
    too high by half of the missing length. The object may also be another kind of thing, so its centre does not move.
    """
    changed = list(objects)
    for label in sorted({one.label for one in objects}):
        mine = [j for j, one in enumerate(objects) if one.label == label and one.body and one.covariance is not None]
        if len(mine) < _FEWEST:
            continue
        missing = _missing(*_heights_and_feet([objects[j] for j in mine]))
        for j, length in zip(mine, missing.tolist(), strict=True):
            one = objects[j]
            if length and one.body is not None and one.covariance is not None:
                size_sigma = np.hypot(one.body.size_sigma, [0.0, 0.0, length])
                covariance = one.covariance + np.diag([0.0, 0.0, (length / 2) ** 2])
                changed[j] = replace(one, covariance=covariance, body=replace(one.body, size_sigma=size_sigma))
    return tuple(changed)


def _heights_and_feet(objects: list[MapObject]) -> tuple[Floats, Floats, Floats]:
    """Return the heights (n,), their standard deviations (n,), and the heights of the feet (n,) of objects, m."""
    told = [
        (one.body.size[2], one.body.size_sigma[2], one.position[2] - one.body.size[2] / 2) for one in objects if one.body
    ]
    height, sigma, foot = np.array(told).T
    return height, sigma, foot


def _missing(height: Floats, sigma: Floats, foot: Floats) -> Floats:
    """Return the length (n,), m, that may be missing at the foot of each thing, 0 if nothing is. The arguments are those
    that `_heights_and_feet` returns."""
    top, low = height + foot, float(np.quantile(foot, _SEEN))
    usual = float(np.median(top))
    spread = float(np.median(np.abs(top - usual)))
    if spread > _ALIKE * (usual - low):
        return np.zeros(len(height))
    raised = foot - low
    short = np.maximum(usual - low - height, raised)
    hidden = raised > max(_SIGMAS * spread / NORMAL_MEDIAN, _LEAST * (usual - low))
    # A possibly hidden foot makes the height unsure. Such a height is no reason against a hidden foot.
    hidden &= (np.abs(top - usual) < raised / 2) & (short > sigma)
    return np.where(hidden, short, 0.0)
