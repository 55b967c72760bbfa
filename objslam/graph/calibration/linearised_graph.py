"""The joint graph, linearised at given values of its variables."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.least_squares.joint_rows import JointGraph, JointRows
from objslam.graph.least_squares.normal_equations import Equations, factored


@dataclass(frozen=True)
class Linearised:
    """The graph of a joint solve with Huber's loss, and values of its variables.

    map_T_camera: (K, 4, 4). positions: (N, 3) m in map, NaN for a landmark outside the graph. used: (R,) a mask of the rays
    in the graph. order: (D,) the order in which the columns of the Jacobian are eliminated. known: the graph, which states
    with the same measurements share. For `order` and `known`, None means not known yet.
    """

    measured: Measurements
    association: Association
    map_T_camera: Floats
    positions: Floats
    used: Bools
    order: Ints | None = None
    known: JointGraph | None = None

    @property
    def which(self) -> Ints:
        """(n,) the indices of the rays in the graph."""
        return np.flatnonzero(self.used)

    @property
    def landmarks(self) -> Ints:
        """(m,) the indices of the landmarks in the graph."""
        return np.flatnonzero(np.isfinite(self.positions[:, 0]))

    @cached_property
    def graph(self) -> JointGraph:
        """The graph. The means of the weak priors of landmarks are the `positions` at which the graph was made."""
        if self.known is not None:
            return self.known
        return JointGraph.of(self.measured, self.association, self.used, self.positions)

    @cached_property
    def rows(self) -> JointRows:
        """The rows of the graph at the values of its variables."""
        return self.graph.rows(self.map_T_camera, self.positions[self.landmarks])

    @cached_property
    def normal(self) -> Equations:
        """The normal equations of `rows`. SolveError if they are singular."""
        return factored(self.rows.jacobian, self.rows.chain, self.graph.blocks, self.order)
