"""The record of an estimation, round by round. A round is one association and its solve."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.estimate import Estimate
from objslam.core.geometry import inverse
from objslam.core.types import Association

Why = Literal["fixed", "labels", "association", "merge", "split", "few rays", "bodies"]
Stage = Literal["grow", "solve"]


@dataclass(frozen=True)
class Parameters:
    """The shared errors at one step: P names, values (P,) in the unit of each, and sigma (P,), their standard deviations."""

    names: tuple[str, ...]
    values: Floats
    sigma: Floats


@dataclass(frozen=True)
class Iteration:
    """The state after one step of a solver.

    stage: `grow` adds keyframes to the graph, `solve` is one step of Levenberg-Marquardt. cost: the error of the graph. For
    `grow`, it is the error of the newest part of the graph. path: (k, 3) m, the positions of the robot in map at the k poses
    that are in the graph so far. Images of one stamp share a pose. positions: (N, 3) m, NaN for an object that is not in the
    graph. parameters: the shared errors, None if this step does not change them.
    """

    stage: Stage
    cost: float
    path: NDArray[np.float32]
    positions: NDArray[np.float32]
    parameters: Parameters | None = None


@dataclass(frozen=True)
class Round:
    """One association and the estimate from it.

    why: `fixed` for fixed poses, `labels` for one object per label, `association` for a new association at the current
    poses, `merge` for merged copies of one object, `split` for objects that may be two, `few rays` for objects that few rays
    show, `bodies` for bearings to bodies' centres. map_T_base: (K, 4, 4). positions: (N, 3) m. weight: (R,) the robust
    weight of each ray.
    """

    why: Why
    association: Association
    iterations: tuple[Iteration, ...]
    map_T_base: Floats
    positions: Floats
    weight: Floats


@dataclass
class Trace:
    """A collector of the rounds of an estimation.

    base_T_camera: (K, 4, 4) the camera on the robot at each keyframe. count: the number of objects, which are the first
    positions of an iteration. Later positions, such as corners of fiducials, are left out. If None, all positions are kept.
    """

    base_T_camera: Floats
    count: int | None = None
    rounds: list[Round] = field(default_factory=list)
    _iterations: list[Iteration] = field(default_factory=list)

    def iteration(
        self, stage: Stage, cost: float, map_T_camera: Floats, positions: Floats, parameters: Parameters | None = None
    ) -> None:
        """Add one step of a solver, with the camera poses (k, 4, 4) of the first k keyframes and object positions (N, 3)."""
        path = (map_T_camera @ inverse(self.base_T_camera[: len(map_T_camera)]))[:, :3, 3]
        step = Iteration(stage, cost, path.astype(np.float32), positions[: self.count].astype(np.float32), parameters)
        self._iterations.append(step)

    def aside(self) -> Trace:
        """Return an empty trace for an attempt that may fail."""
        return Trace(self.base_T_camera, self.count)

    def take(self, attempt: Trace) -> None:
        """Add the rounds and the iterations of an attempt that succeeded."""
        self.rounds += attempt.rounds
        self._iterations += attempt._iterations

    def replace(self, attempt: Trace) -> None:
        """Replace the iterations since the end of the previous round by the iterations of an attempt."""
        self._iterations = list(attempt._iterations)

    def end_round(self, why: Why, association: Association, estimate: Estimate) -> None:
        """End a round. The round gets all iterations since the end of the previous round."""
        iterations, self._iterations = tuple(self._iterations), []
        self.rounds.append(Round(why, association, iterations, estimate.map_T_base, estimate.positions, estimate.weight))
