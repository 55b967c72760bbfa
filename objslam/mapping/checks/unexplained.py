"""A check of the association: the number of boxes without an object."""

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.core.types import Association, Rays

_USUAL = 0.12
"""The usual share of boxes that are false or show moving objects. With a larger share, there are fewer warnings."""
_IMPLAUSIBLE = 0.4
"""If more than this share of the boxes has no object, the input may be wrong. In simulation, right input has 0.1. Swapped
axes, mirrored images or boxes of another image size have at least 0.5. A larger share warns less often."""
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
        why += f"; unless most things move, the input may be wrong: check {_INPUT}"
    ledger.warn(f"no object at rest explains {left.sum()} of {len(left)} boxes ({worst}){why}")
