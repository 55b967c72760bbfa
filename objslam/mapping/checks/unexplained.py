"""A check of the association: how many boxes belong to no object."""

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.core.types import Association, Rays

_USUAL = 0.12
"""The usual share of boxes that are false or show moving objects. A larger share warns less often."""
_IMPLAUSIBLE = 0.4
"""The share of boxes without an object above which the input may be wrong. In simulation it is 0.1 for right input, and
at least 0.5 for swapped axes, mirrored images or boxes of another image size. A larger share warns less often."""
_INPUT = "the stamps, base_T_camera, the axes of the poses, and that boxes are x1 y1 x2 y2 in px of this image size"


def warn_of_unexplained(rays: Rays, association: Association, ledger: Ledger) -> None:
    """Warn if there is no object, or if more boxes than usual belong to no object."""
    left = association.object < 0
    if association.count and left.mean() <= _USUAL:
        return
    number = np.bincount(rays.label[left], minlength=len(rays.label_names))
    worst = ", ".join(f"{rays.label_names[i]} {number[i]}" for i in np.argsort(-number, kind="stable")[:3] if number[i])
    why = "" if association.count else "; an object needs at least three boxes from three places that agree"
    if left.mean() > _IMPLAUSIBLE:
        why += f"; unless most things move, the input may be wrong: check {_INPUT}"
    ledger.warn(f"{left.sum()} of {len(left)} boxes are explained by no object at rest ({worst}){why}")
