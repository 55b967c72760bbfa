"""Find boxes of another recording among those of a log: whole frames fit, or whole frames do not."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.mapping.checks.agreement import Agreement, Part
from objslam.mapping.checks.finding import Finding

_RAYS, _FRAMES = 3, 40
"""The fewest rays of a frame, and the fewest such frames, that are judged. Fewer rays fit or not by chance."""
_BAD, _GOOD = 0.34, 0.67
"""The shares of fitting rays up to which a frame is bad, and from which on it is good. Values farther apart find fewer."""
_LEAST = 0.2
"""The least share of bad and of good frames. A larger share finds less of another recording."""
_DISPERSION = 1.6
"""How many times more the shares of frames vary than false boxes at random let them. Clean logs have 0.8 to 1.0, and
those with half of the boxes from another recording 2.1 to 2.6."""


def check_mixture(found: Agreement, part: Part) -> Finding | None:
    """Return whether some frames belong to another recording. Odometry drifts within windows, so it cannot tell."""
    if part.drifts:
        return None
    return find_mixture(found.rays.keyframe, found.point >= 0)


def find_mixture(frame: Ints, fits: Bools) -> Finding | None:
    """Return whether rays fit by whole frames. frame: (R,) the frame of each ray. fits: (R,) whether it fits its object."""
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
