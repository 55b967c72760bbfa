"""Accelerate an iteration that converges slowly."""

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Floats

MEMORY = 3
"""The number of earlier steps that Anderson's acceleration uses. A larger number extrapolates farther, and less safely."""


def accelerated(history: Sequence[tuple[Floats, Floats]], scale: Floats | float) -> Floats:
    """Return the next parameters (P,) by Anderson's acceleration (Walker and Ni 2011, eq. 2.2).

    history: pairs of parameters (P,) and the step (P,) from them, the newest last. scale: (P,) a typical size of each
    parameter. Steps are compared in these units.
    """
    theta, step = history[-1]
    if len(history) < 2:
        return theta + step
    thetas, steps = (np.diff(np.array(part) / scale, axis=0).T for part in zip(*history, strict=True))
    mix = np.linalg.lstsq(steps, step / scale, rcond=0.05)[0]
    return np.asarray(theta + step - scale * ((thetas + steps) @ mix))
