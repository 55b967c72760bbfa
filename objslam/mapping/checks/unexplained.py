"""A check of the association: the number of boxes without an object."""

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.types import Association, Rays

_USUAL = 0.12
"""The usual share of boxes without an object, because they are false or show moving objects. A larger share warns less
often."""
_IMPLAUSIBLE = 0.4
"""The share of boxes without an object above which the input may be wrong. In simulation, right input has 0.1. Swapped axes,
mirrored images or boxes of another image size have at least 0.5. A larger share warns less often."""
_FITS, _ENOUGH = 0.2, 0.3
"""The limits for the verdict that the input is right, but some labels do not fit. At most the share `_FITS` of the boxes of
the other labels has no object, and the other labels have at least the share `_ENOUGH` of all boxes. In a simulated
classroom, 0.87 of the boxes of desks and 0.15 of the others had no object. A larger `_FITS`, or a smaller `_ENOUGH`, doubts
the input less often."""
_INPUT = "the stamps, base_T_camera, the axes of the poses, and that boxes are x1 y1 x2 y2 in px of this image size"


def warn_of_unexplained(rays: Rays, association: Association, ledger: Ledger) -> None:
    """Warn if there is no object, or if more boxes than usual belong to no object."""
    left = association.object < 0
    if association.count and left.mean() <= _USUAL:
        return
    number = np.bincount(rays.label[left], minlength=len(rays.label_names))
    worst = ", ".join(f"{rays.label_names[i]}: {number[i]}" for i in np.argsort(-number, kind="stable")[:3] if number[i])
    why = "" if association.count else "; an object needs at least three boxes from three places that agree"
    if left.mean() > _IMPLAUSIBLE:
        why += _cause(rays, left, number)
    ledger.warn(f"no object at rest explains {left.sum()} of {len(left)} boxes ({worst}){why}")


def _cause(rays: Rays, left: Bools, number: Ints) -> str:
    """Return the probable cause if many boxes have no object. left: (R,) the boxes without one. number: (L,) their number by
    label."""
    every = np.bincount(rays.label, minlength=len(number))
    bad = number > _IMPLAUSIBLE * every
    others = ~bad[rays.label]
    if others.mean() < _ENOUGH or left[others].mean() > _FITS:
        return f"; unless most things move, the input may be wrong: check {_INPUT}"
    names = ", ".join(f"'{rays.label_names[i]}'" for i in np.flatnonzero(bad)[np.argsort(-number[bad], kind="stable")][:3])
    return (
        f"; the other labels fit, so the input is probably right: things labelled {names} move, hide each other, or stand "
        "in long rows of equal things"
    )
