"""Compare the halves of a log: how many rays of each fit, and whether both see the same objects."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.mapping.checks.finding import Finding

_HALF = 0.5
"""The share of rays that fit in one half of a log, compared with the other half, below which the halves differ. A larger
share finds smaller differences."""
_FEW, _PART = 2, 0.1
"""The fewest rays, and the least share of all its rays, by which an object is seen in a half. Smaller values take chance for
an object. Of the boxes of another recording, about a tenth fit an object of the same label by chance."""


def check_halves(late: Bools, fits: Bools) -> Finding | None:
    """Return whether one half of the log fits worse than the other.

    late: (R,) whether a ray is in the second half. fits: (R,) whether it fits its object.
    """
    shares = [float(fits[mask].mean()) if mask.any() else 0.0 for mask in (~late, late)]
    if min(shares) >= _HALF * max(shares):
        return None
    return Finding(
        "halves differ",
        f"{100 * shares[0]:.0f} % of the rays fit in the first half of the log, {100 * shares[1]:.0f} % in the "
        "second: the poses, the camera or the boxes of one half belong to something else",
        basis="halves",
    )


def seen_in_both(late: Bools, fits: Bools, owner: Ints) -> float:
    """Return the share of the fitting rays of a half that belong to objects which the other half sees as well.

    It is that of the half with the larger share: a robot that goes on to new places sees most of the old ones no more.
    late, fits: as in `check_halves`. owner: (R,) the object of each ray, -1 for none.
    """
    count = int(owner.max(initial=-1)) + 1
    seen = np.stack([np.bincount(owner[fits & mask], minlength=count) for mask in (~late, late)])
    both = np.append((seen >= np.maximum(_FEW, _PART * seen.sum(axis=0))).all(axis=0), False)  # -1 is no object
    return max(float(both[owner[fits & mask]].mean()) if (fits & mask).any() else 0.0 for mask in (~late, late))
