"""What the estimation went through, kept so that one can step through it: a round is one association and its solve."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.estimate import Estimate
from objslam.core.geometry import inverse
from objslam.core.types import Association

Why = Literal["fixed", "labels", "association", "merge"]
Stage = Literal["grow", "solve"]


@dataclass(frozen=True)
class Iteration:
    """The state after one step of a solver: `grow`, the graph grown by some keyframes; `solve`, one of Levenberg-Marquardt.

    cost: the error of the graph as it then was. path: (k, 3) m, the robot in map at the first k keyframes, those in the
    graph. positions: (N, 3) m, NaN where an object is not in the graph.
    """

    stage: Stage
    cost: float
    path: NDArray[np.float32]
    positions: NDArray[np.float32]


@dataclass(frozen=True)
class Round:
    """One association and what its solve made of it.

    why: `fixed` poses, every label taken for one object (`labels`), a new `association` at the poses so far, or a `merge`
    of two visits. map_T_base (K, 4, 4), positions (N, 3) and weight (R,): as in the estimate.
    """

    why: Why
    association: Association
    iterations: tuple[Iteration, ...]
    map_T_base: Floats
    positions: Floats
    weight: Floats


@dataclass
class Trace:
    """Collects the rounds; base_T_camera (K, 4, 4) turns the solver's camera poses into the robot's."""

    base_T_camera: Floats
    rounds: list[Round] = field(default_factory=list)
    _iterations: list[Iteration] = field(default_factory=list)

    def iteration(self, stage: Stage, cost: float, map_T_camera: Floats, positions: Floats) -> None:
        """One step, with the camera poses (k, 4, 4) of the first k keyframes and the objects (N, 3)."""
        path = (map_T_camera @ inverse(self.base_T_camera[: len(map_T_camera)]))[:, :3, 3]
        self._iterations.append(Iteration(stage, cost, path.astype(np.float32), positions.astype(np.float32)))

    def aside(self) -> Trace:
        """A trace for an attempt that may come to nothing."""
        return Trace(self.base_T_camera)

    def take(self, attempt: Trace) -> None:
        """The iterations of an attempt that was worth it."""
        self._iterations += attempt._iterations

    def end_round(self, why: Why, association: Association, estimate: Estimate) -> None:
        """The round that the iterations since the last one made."""
        iterations = tuple(self._iterations)
        self._iterations.clear()
        self.rounds.append(Round(why, association, iterations, estimate.map_T_base, estimate.positions, estimate.weight))
