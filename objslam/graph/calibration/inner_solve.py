"""The inner solve of a calibration. It finds poses and landmarks at given shared errors."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import exp_se3
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.shared_error_jacobian import ReducedSystem
from objslam.graph.least_squares.normal_equations import Equations, elimination_order
from objslam.graph.optimizers import levenberg_marquardt
from objslam.graph.outlier_rejection import Near, order_near, supported
from objslam.graph.variables import read_poses, with_points

_INNER = 4
"""The most steps of an inner solve. Few steps are enough, because the solve begins at a linear prediction of its optimum.
More steps are more exact and slower."""
_TOLERANCE = 1e-4
"""The relative decrease of the cost below which an inner solve ends, as the next step predicts it. A larger share ends the
solve sooner."""


@dataclass(frozen=True)
class InnerSolve(Linearised):
    """A graph for given parameters, with its variables near their optimum. It is called a state here.

    stale: the factorised normal equations of another state nearby, which the next step uses. None means that the state uses
    its own equations. A step with stale equations takes a fifth of the time, because no matrix is built and factorised.
    """

    stale: Equations | None = None

    @property
    def factored(self) -> Equations:
        """The normal equations of the next step."""
        return self.normal if self.stale is None else self.stale

    @property
    def cost(self) -> float:
        """The cost at the optimum, as the next step of an inner solve predicts it."""
        return self.rows.cost - self.decrease

    @cached_property
    def gradient(self) -> Floats:
        """(D,) the gradient of the cost by the variables."""
        return self.rows.jacobian.T @ self.rows.residual

    @cached_property
    def step(self) -> Floats:
        """(D,) the next step of an inner solve, by Gauss-Newton or, with `stale` normal equations, by the chord method."""
        return -self.factored.solve(self.gradient)

    @property
    def decrease(self) -> float:
        """The decrease of the cost by `step`, in the linear system."""
        return float(-self.gradient @ self.step) / 2

    def ordered(self, near: Near | None) -> Self:
        """Return the state with an order of elimination. All states that are made from it share this order.

        near: an earlier solve. If it had the same variables, its order is taken.
        """
        known = order_near(near, self.landmarks)
        if known is None and not self.graph.is_chain:
            known = elimination_order(self.rows.jacobian, self.graph.blocks)
        return replace(self, order=known, known=self.graph)

    def moved(self, change: Floats) -> Self:
        """Return the state after a change (D,) of its variables."""
        landmarks = self.landmarks
        positions = self.positions.copy()
        positions[landmarks] += change[: 3 * len(landmarks)].reshape(-1, 3)
        return replace(
            self,
            map_T_camera=self.map_T_camera @ exp_se3(change[3 * len(landmarks) :].reshape(-1, 6)),
            positions=positions,
            known=self.graph,
        )

    def predicted(self, system: ReducedSystem, step: Floats, measured: Measurements) -> Self:
        """Return the linear prediction of the optimum after a step (P,) of the parameters.

        measured: the measurements at the parameters after the step.
        """
        moved = self.moved(system.sensitivity @ step + system.newton)
        return replace(moved, stale=self.normal).measuring(measured)

    def measuring(self, measured: Measurements) -> Self:
        """Return the state with other measured values of the same rays and motions."""
        return replace(self, measured=measured, known=self.graph.measuring(measured))

    def solved(self) -> Self:
        """Return the state after at most `_INNER` steps, or `_damped` if a step does not lower the cost.

        A step uses the normal equations of the previous step (chord method). Between steps, only the robust weights and the
        directions change a little. The gradient is fresh, so the steps lead to the same optimum as Gauss-Newton steps. A
        chord step that does not lower the cost is replaced by a step with fresh normal equations.
        """
        state = self
        for _ in range(_INNER):
            if state.decrease <= _TOLERANCE * state.rows.cost:
                break
            after = replace(state.moved(state.step), stale=state.factored)
            if after.rows.cost <= state.rows.cost:
                state = after
            elif state.stale is None:
                return state._damped()
            else:
                state = state.fresh()
        return state

    def fresh(self) -> Self:
        """Return the state whose next step has its own normal equations."""
        return replace(self, stale=None)

    def _damped(self) -> Self:
        """Return the state after at most `_INNER` iterations of Levenberg-Marquardt."""
        landmarks = self.landmarks
        graph, values = self.measured.whole(self.association.object, self.used, self.map_T_camera, self.positions)
        found = levenberg_marquardt(graph, values, _INNER, _TOLERANCE).values
        return replace(self, map_T_camera=read_poses(found), positions=with_points(self.positions, landmarks, found))

    def settled(self) -> Self:
        """Return the state in which those rays are used that agree with their objects at the present values."""
        used = supported(self.measured.rays, self.association, self.map_T_camera, self.positions, self.used)
        return self if np.array_equal(used, self.used) else replace(self, used=used, known=None)
