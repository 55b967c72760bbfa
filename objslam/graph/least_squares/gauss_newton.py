"""Solve a joint graph on arrays, from near its optimum, by Gauss-Newton steps that share their normal equations.

A GTSAM graph has an object for each ray and each motion. To make and linearise these objects takes longer than such a solve.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import exp_se3
from objslam.errors import SolveError
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.least_squares.normal_equations import Equations, factored

_SLOW = 0.5
"""The largest ratio of the decrease of the cost that a step predicts to the decrease that the previous step predicted. Above
this ratio, the normal equations are computed again. With a larger ratio, they are computed more rarely, and a solve takes
more steps. With old equations, a step takes a fifth of the time."""

OnStep = Callable[[float, Floats, Floats], None]
"""A function that is called after each step with the cost, the poses (P, 4, 4) and the positions (m, 3)."""


@dataclass(frozen=True)
class Solution:
    """The values where a solve ended: map_T_camera (P, 4, 4) and landmarks (m, 3), m.

    cost_before, cost_after: half the sums of the squared residuals, with the robust losses. steps: the number of steps.
    ended: whether the solve converged. If not, a step did not lower the cost, or the steps ran out, or the normal equations
    are singular. normal: the normal equations of the last steps, None if the first were singular.
    """

    map_T_camera: Floats
    landmarks: Floats
    cost_before: float
    cost_after: float
    steps: int
    ended: bool
    normal: Equations | None


def gauss_newton(
    graph: JointGraph,
    map_T_camera: Floats,
    normal: Equations | None,
    most: int,
    tolerance: float,
    still: float,
    on_step: OnStep | None = None,
) -> Solution:
    """Minimise the cost of a graph. The landmarks start at the means `graph.weak` of their priors.

    A step reuses the normal equations of the previous step (chord method), as long as the cost decreases quickly. These
    equations are still nearly right, because only robust weights and directions change between steps. Each step computes the
    gradient again, so the optimum is the same.

    Args:
        graph: the measurements.
        map_T_camera: (P, 4, 4) the poses at the start.
        normal: the normal equations of a solve that ended nearby, with the same variables. If None, they are computed at the
            start.
        most: the largest number of steps.
        tolerance: the solve ends after a step whose predicted decrease of the cost is at most this share of the cost.
        still: the solve also ends after a step whose predicted decrease is at most this cost, for example
            `optimizers.STILL`.
        on_step: called after each step.
    """
    poses, landmarks = map_T_camera, graph.weak
    rows, promised, ended, steps = graph.rows(poses, landmarks), np.inf, False, 0
    before, anew = rows.cost, normal is None
    while steps < most and not ended and np.isfinite(rows.cost):
        gradient = rows.jacobian.T @ rows.residual
        if anew:
            try:
                order = None if normal is None else normal.order
                normal = factored(rows.jacobian, rows.chain, graph.blocks, order)
            except SolveError:
                break
        assert normal is not None
        step = -normal.solve(gradient)
        decrease = float(-(gradient @ step)) / 2
        if not anew and decrease > _SLOW * promised:
            anew = True
            continue
        moved = poses @ exp_se3(step[landmarks.size :].reshape(-1, 6))
        places = landmarks + step[: landmarks.size].reshape(-1, 3)
        after = graph.rows(moved, places)
        ended = decrease <= max(still, tolerance * rows.cost)
        if after.cost <= rows.cost:
            poses, landmarks, rows, promised = moved, places, after, decrease
            anew, steps = False, steps + 1
            if on_step is not None:
                on_step(rows.cost, poses, landmarks)
        elif anew:
            ended = False
            break
        else:
            anew, ended = True, False
    return Solution(poses, landmarks, before, rows.cost, steps, ended, normal)
