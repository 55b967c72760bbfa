"""Divide a path into stretches. The states of a stretch are planar corrections on a grid."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Keyframes

_SHIFTS, _TURNS = 9, 14
"""The number of grid steps to each side, along x and y, and in yaw. Larger numbers reach farther, and take longer."""
STRETCH = 0.5
"""The largest standard deviation of the drift of the heading in a stretch, in grid steps of yaw. The odometry counts as
exact in a stretch. A larger value makes longer stretches."""
_STRETCH_SHIFTS = 2.0
"""The greatest length of a stretch, in grid steps of a shift. A larger value makes longer stretches, for which a single
correction is less exact."""

Cells = NDArray[np.float32]


@dataclass(frozen=True)
class Grid:
    """The states: all combinations of shifts along x and along y, and of turns. shift: m, turn: rad, the sizes of the grid
    steps."""

    shift: float
    turn: float

    @cached_property
    def shifts(self) -> Floats:
        """The shifts (X,) m along x or y."""
        return np.asarray(np.arange(-_SHIFTS, _SHIFTS + 1) * self.shift)

    @cached_property
    def turns(self) -> Floats:
        """The turns (Y,) rad about the vertical axis."""
        return np.asarray(np.arange(-_TURNS, _TURNS + 1) * self.turn)


def stretches(keyframes: Keyframes, grid: Grid) -> Ints:
    """Return the index (K,) of the stretch of each keyframe."""
    assert keyframes.drift is not None
    assert keyframes.odom_T_base is not None
    heading = np.linalg.eigvalsh(keyframes.drift[:, :3, :3])[:, -1].tolist()  # rad^2
    places = keyframes.odom_T_base[:, :3, 3]
    longest, widest = _STRETCH_SHIFTS * grid.shift, (STRETCH * grid.turn) ** 2
    found, begin, number = np.zeros(len(places), dtype=np.int64), 0, 0
    for k in range(1, len(places)):
        if heading[k] - heading[begin] > widest or np.linalg.norm(places[k] - places[begin]) > longest:
            begin, number = k, number + 1
        found[k] = number
    return found
