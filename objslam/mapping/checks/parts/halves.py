"""Compare the halves of a log: the shares of fitting rays, and the objects that both halves see."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.mapping.checks.finding import Finding

_HALF = 0.5
"""The ratio between the shares of fitting rays in the two halves, worse to better, below which the halves differ. A larger
value finds smaller differences."""
_FEW, _PART = 2, 0.1
"""A half sees an object if it has at least `_FEW` of the object's fitting rays, and at least the share `_PART` of them. With
smaller values, a fit by chance counts as an object. About a tenth of the boxes of another recording fit an object of their
label by chance."""


def check_halves(late: Bools, fits: Bools) -> Finding | None:
    """Return a finding if one half of the log fits worse than the other half.

    late: (R,) whether a ray is in the second half. fits: (R,) whether a ray fits its object. If one half has no rays, there
    is no finding.
    """
    if late.all() or not late.any():
        return None
    shares = [float(fits[mask].mean()) for mask in (~late, late)]
    if min(shares) >= _HALF * max(shares):
        return None
    return Finding(
        "halves differ",
        f"{100 * shares[0]:.0f} % of the rays fit in the first half of the log, {100 * shares[1]:.0f} % in the "
        "second: the poses, the camera or the boxes of one half belong to something else",
        basis="halves",
    )


def seen_in_both(late: Bools, fits: Bools, owner: Ints) -> float:
    """Return the share of a half's fitting rays whose objects the other half sees too. The larger share of the two halves
    counts.

    A robot that drives on to new places no longer sees most of the old objects, so the smaller share says less. late, fits:
    as in `check_halves`. owner: (R,) the object of each ray, -1 for none.
    """
    count = int(owner.max(initial=-1)) + 1
    seen = np.stack([np.bincount(owner[fits & mask], minlength=count) for mask in (~late, late)])
    both = np.append((seen >= np.maximum(_FEW, _PART * seen.sum(axis=0))).all(axis=0), False)  # -1 is no object
    return max(float(both[owner[fits & mask]].mean()) if (fits & mask).any() else 0.0 for mask in (~late, late))
