"""The most likely states of all stretches of a path, by dynamic programming (Viterbi 1967)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from objslam.association.path_search.state_grid import Cells, Grid
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse, log_se3
from objslam.core.types import Keyframes

_LEAST_DRIFT = 0.6
"""The least standard deviation of the drift between two stretches, in grid steps. Below half a step, states could not follow
a slow drift. A larger value trusts the odometry less."""
_SLIP = 20.0
"""The largest cost of a motion, in squared deviations, because wheels can slip more than a Gaussian allows. A larger value
lets fewer motions disagree with the odometry."""
_LEVELS = 250
"""The number of levels between 0 and `_SLIP` at which costs are stored, one byte each. A larger number is more exact."""


@dataclass(frozen=True)
class Motions:
    """The motions from each of G stretches of the path to the next. error: (G - 1, 3) the motion of the present path minus
    the motion of the odometry: x, y (m) and yaw (rad), along the axes of map. variance: (G - 1, 3) of this error, from the
    odometry's drift. way: (G - 1, 2) m, the motion in x and y."""

    error: Floats
    variance: Floats
    way: Floats

    @classmethod
    def of(cls, keyframes: Keyframes, middle: Ints, base: Floats, grid: Grid) -> Self:
        """Compare the motions of the path and of the odometry. middle: (G,) the keyframe at the middle of each stretch.
        base: (G, 4, 4) the poses of the path at these keyframes."""
        assert keyframes.drift is not None
        assert keyframes.odom_T_base is not None
        odometry = keyframes.odom_T_base[middle]
        measured, moved = (inverse(poses[:-1]) @ poses[1:] for poses in (odometry, base))
        twist = log_se3(inverse(measured) @ moved)
        to_base = adjoint(inverse(odometry[1:]))
        drift = to_base @ np.diff(keyframes.drift[middle], axis=0) @ np.swapaxes(to_base, 1, 2)
        turn = base[1:, :3, :3]
        shift = np.einsum("gij,gj->gi", turn, twist[:, 3:])[:, :2]
        spread = np.diagonal(turn @ drift[:, 3:, 3:] @ np.swapaxes(turn, 1, 2), axis1=1, axis2=2)[:, :2]
        least = (_LEAST_DRIFT * np.array([grid.shift, grid.shift, grid.turn])) ** 2
        return cls(
            error=np.column_stack([shift, np.einsum("gj,gj->g", turn[:, 2], twist[:, :3])]),
            variance=np.maximum(np.column_stack([spread, drift[:, 2, 2]]), least),
            way=np.diff(base[:, :2, 3], axis=0),
        )

    def costs(self, k: int, grid: Grid) -> tuple[Cells, Cells, Cells]:
        """Return the costs of motion `k` in x (2 X - 1, Y), in y (2 X - 1, Y) and in yaw (2 Y - 1,).

        The grid has X shifts along each axis, and Y turns. The first axis of an array is the step from the previous state to
        the next one, in increasing order. The second axis is the yaw of the states, because a step in x or y depends on it.
        The drift in x, y and yaw counts as independent.
        """
        shifts, turns = (np.arange(1 - len(axis), len(axis)) for axis in (grid.shifts, grid.turns))
        cos, sin, way = np.cos(grid.turns) - 1, np.sin(grid.turns), self.way[k]
        carried = cos * way[0] - sin * way[1], sin * way[0] + cos * way[1]  # A turn about one pivot shifts the next one.
        x, y = (
            ((shifts * grid.shift)[:, None] - carried[axis] + self.error[k, axis]) ** 2 / self.variance[k, axis]
            for axis in (0, 1)
        )
        yaw = (turns * grid.turn + self.error[k, 2]) ** 2 / self.variance[k, 2]
        return x.astype(np.float32), y.astype(np.float32), yaw.astype(np.float32)


def most_likely_states(motions: Motions, costs: Iterator[Cells], grid: Grid) -> Floats:
    """Return the states (G, 3) of x, y (m) and yaw (rad) with the least total cost. costs: (Y, X, X) of each stretch.

    A state that costs `_SLIP` more than the best state of its stretch is on no best path, because a slip from the best state
    costs less. So a byte is enough for the difference from the cost of the best state.
    """
    stored, total = list[NDArray[np.uint8]](), np.zeros(0, dtype=np.float32)
    for k, seen in enumerate(costs):
        total = _reached(total, *motions.costs(k - 1, grid)) + seen if k else seen
        total = total - total.min()
        stored.append(np.minimum(np.rint(total * (_LEVELS / _SLIP)), _LEVELS + 1).astype(np.uint8))
    found = np.zeros((len(stored), 3))
    at = np.unravel_index(np.argmin(total), total.shape)
    for k in range(len(stored) - 1, -1, -1):
        found[k] = grid.shifts[at[1]], grid.shifts[at[2]], grid.turns[at[0]]
        if k:
            x, y, yaw = motions.costs(k - 1, grid)
            before = stored[k - 1] * np.float32(_SLIP / _LEVELS)
            turn, east, north = (int(i) for i in at)
            turning, count = yaw[_steps_to(turn, len(before))], before.shape[1]
            along_x, along_y = x[_steps_to(east, count)].T, y[_steps_to(north, count)].T
            from_there = before + along_x[:, :, None] + along_y[:, None, :] + turning[:, None, None]
            slipped = from_there.min() > _SLIP
            at = np.unravel_index(np.argmin(before if slipped else from_there), before.shape)
    return found


def _steps_to(state: int, count: int) -> slice:
    """Return the indices in `Motions.costs` of the steps to `state` from each of `count` states, in increasing order."""
    return slice(state + count - 1, state - 1 if state else None, -1)


def _reached(total: Cells, x: Cells, y: Cells, yaw: Cells) -> Cells:
    """Return for each state the least sum (Y, X, X) of two costs: the cost of a state before, and the cost of the motion
    from it.

    A sum is at most `_SLIP`. Only states below `_SLIP` can lead to a smaller sum, so only the part of the grid that contains
    them is searched. This part is small where the rays show well where the robot is.

    Args:
        total: (Y, X, X) the costs of the states before.
        x, y, yaw: as in `Motions.costs`.
    """
    below = total < _SLIP
    turns, east, north = (_extent(np.any(below, axis=others, keepdims=True).ravel()) for others in ((1, 2), (0, 2), (0, 1)))
    part = total[turns, east, north]
    part, east = _least(part, x[:, turns], east, total.shape[1])
    part, north = _least(np.swapaxes(part, 1, 2), y[:, turns], north, total.shape[2])
    part, turns = _least(np.transpose(part, (2, 0, 1)), yaw[:, None], turns, len(total))
    reached = np.full_like(total, _SLIP)
    reached[turns, east, north] = np.swapaxes(part, 0, 1)
    return reached


def _extent(there: Bools) -> slice:
    """Return the slice from the first to the last entry of a mask (n,) that is true."""
    return slice(int(there.argmax()), len(there) - int(there[::-1].argmax()))


def _least(total: Cells, cost: Cells, states: slice, count: int) -> tuple[Cells, slice]:
    """Take a step along the second axis of a grid of states.

    A sum is the cost of a state before, plus the cost of the step from there. Return the least sum (m, W, n) for each state
    that is reached, and where the W reached states are on the second axis.

    A sum is at most `_SLIP`, so only the steps that cost less are tried. They are few, because the odometry drifts little
    between two stretches of the path. To compute the sums of all steps at once takes three times as long.

    Args:
        total: (m, V, n) the costs of the states before.
        cost: (2 count - 1, m) the costs of the steps. The second axis may have length 1.
        states: where the V states are on the second axis.
        count: the number of all states on the second axis.
    """
    total = np.ascontiguousarray(total)
    cheap = np.flatnonzero(cost.min(axis=1) < _SLIP)
    steps = (cheap - (count - 1)).tolist() or [0]
    after = slice(max(states.start + steps[0], 0), min(states.stop + steps[-1], count))
    if not len(cheap) or after.start >= after.stop:  # Only a slip reaches a state.
        return np.full_like(total, _SLIP), states
    least = np.full((len(total), after.stop - after.start, total.shape[2]), _SLIP, dtype=total.dtype)
    for step, of_step in zip(steps, cost[cheap], strict=True):
        begin, end = max(states.start + step, 0), min(states.stop + step, count)
        if begin < end:
            here = least[:, begin - after.start : end - after.start]
            before = total[:, begin - step - states.start : end - step - states.start]
            np.minimum(here, before + of_step[:, None, None], out=here)
    return least, after
