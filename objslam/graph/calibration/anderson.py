"""Accelerate an iteration that converges slowly."""

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Floats

MEMORY = 3
"""The steps that Anderson's acceleration looks back on; more extrapolates farther, and less safely."""


def accelerated(history: Sequence[tuple[Floats, Floats]], scale: Floats | float) -> Floats:
    """Return the next parameters (P,) by Anderson's acceleration (Walker and Ni 2011, eq. 2.2).

    history: parameters and the step from them, the newest last. scale: (P,) in what unit each parameter is compared.
    """
    theta, step = history[-1]
    if len(history) < 2:
        return theta + step
    thetas, steps = (np.diff(np.array(part) / scale, axis=0).T for part in zip(*history, strict=True))
    mix = np.linalg.lstsq(steps, step / scale, rcond=0.05)[0]
    return np.asarray(theta + step - scale * ((thetas + steps) @ mix))
