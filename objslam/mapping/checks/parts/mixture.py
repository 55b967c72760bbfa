"""Detect that a log mixes frames of two recordings: in some frames nearly all boxes fit, in others hardly any."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.mapping.checks.agreement import Agreement, Part
from objslam.mapping.checks.finding import Finding

_RAYS, _FRAMES = 3, 40
"""The fewest rays of a judged frame, and the fewest judged frames of a judged log. Fewer rays may all fit, or all miss, by
chance. With larger numbers, fewer logs are judged."""
_BAD, _GOOD = 0.34, 0.67
"""The largest share of fitting rays in a bad frame, and the least share in a good frame. Values farther apart find fewer
mixed logs."""
_LEAST = 0.2
"""The least share of bad frames, and the least share of good frames. A larger value needs more frames of the other
recording."""
_DISPERSION = 1.6
"""The least variance of the frames' shares of fitting rays, as a multiple of the variance by random false boxes. Clean logs
have 0.8 to 1.0. Logs with half of the boxes from another recording have 2.1 to 2.6. A larger value finds fewer mixed
logs."""


def check_mixture(found: Agreement, part: Part) -> Finding | None:
    """Return a finding if some frames belong to another recording. None at poses by odometry, which drift within windows."""
    if part.drifts:
        return None
    judged = ~found.narrow
    return find_mixture(found.rays.keyframe[judged], found.point[judged] >= 0)


def find_mixture(frame: Ints, fits: Bools) -> Finding | None:
    """Return a finding if nearly all rays fit in some frames, and hardly any in others. frame: (R,) the frame of each ray.
    fits: (R,) whether a ray fits."""
    frames = int(frame.max(initial=-1)) + 1
    number, fitting = np.bincount(frame, minlength=frames), np.bincount(frame[fits], minlength=frames)
    judged = number >= _RAYS
    if judged.sum() < _FRAMES:
        return None
    number, fitting = number[judged], fitting[judged]
    share = float(fitting.sum() / number.sum())
    expected = float((number * share * (1 - share)).sum())
    varies = float(((fitting - number * share) ** 2).sum())
    bad, good = float((fitting <= _BAD * number).mean()), float((fitting >= _GOOD * number).mean())
    if min(bad, good) < _LEAST or varies < _DISPERSION * expected:
        return None
    return Finding(
        "mixed recordings",
        f"in {100 * bad:.0f} % of the frames hardly a box fits, in {100 * good:.0f} % nearly all do: "
        "boxes or poses of another recording are probably mixed in",
        basis="frames",
    )
