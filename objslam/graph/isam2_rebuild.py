"""Rebuilds a large iSAM2 graph in slices, while the old one goes on: no frame has to wait until all of it is done."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from objslam.core.arrays import Floats
from objslam.graph.factor_store import FactorStore, Stored
from objslam.graph.variables import LETTER, X0, Variables

_RELINEARISE = (0.02, 0.05)
"""How far (rad, m) a variable moves before its factors are linearised again. Chosen below what bends a bearing noticeably;
larger is faster, and less exact."""
_NEVER = 1_000_000
"""The updates between two looks for variables that moved, where nobody asks for one: the caller knows when there is time."""


def new_isam(others: Mapping[int, gtsam.Pose3 | Floats]) -> gtsam.ISAM2:
    """An iSAM2 with nothing in it, for poses X, points L and the letters of other variables (by key)."""
    parameters = gtsam.ISAM2Params()
    turn, way = _RELINEARISE
    limits = {"x": np.array([turn] * 3 + [way] * 3), "l": np.full(3, way)}
    for key, value in others.items():
        alone = gtsam.Values()
        alone.insert(key, value)
        limits.setdefault(chr(key >> LETTER), np.full(alone.dim(), turn))
    thresholds = gtsam.ISAM2ThresholdMap()
    for limit in limits.items():
        thresholds.insert(limit)
    parameters.setRelinearizeThreshold(thresholds)
    parameters.relinearizeSkip = _NEVER
    return gtsam.ISAM2(parameters)


class IncrementalRebuild:
    """Works in the factors that were stored when it began, keyframe by keyframe; what came since is worked in last.

    order: keyframes, each after the one that its motion comes from. variables: where all are linearised. isam: what has been
    built so far.
    """

    def __init__(self, store: FactorStore, order: list[int], variables: Variables) -> None:
        self.isam = new_isam(variables.others)
        self._variables, self._order = variables, order
        self._at: list[list[Stored]] = [[] for _ in order]  # by the last of its keyframes
        self._alone: dict[int, list[Stored]] = {}  # by the one variable that it is about, no keyframe
        self._last: list[Stored] = []  # about several variables, none of them a keyframe
        place = {X0 + k: i for i, k in enumerate(order)}
        for stored in store.kinds.values():
            for one in stored.values():
                at = max([place.get(key, -1) for key in one.keys])
                if at >= 0:
                    self._at[at].append(one)
                elif len(one.keys) == 1:
                    self._alone.setdefault(next(iter(one.keys)), []).append(one)
                else:
                    self._last.append(one)
        self._done = 0
        self._there: set[int] = set()
        self._later: list[gtsam.NonlinearFactor] = []
        self._new: list[int] = []

    @property
    def last(self) -> bool:
        """Whether only what came since is left: `finish` takes it."""
        return self._done >= len(self._order)

    def add_variable(self, key: int) -> None:
        """A variable that came since."""
        self._new.append(key)

    def add_factor(self, factor: gtsam.NonlinearFactor) -> None:
        """A factor that came since."""
        self._later.append(factor)

    def step(self, keyframes: int) -> None:
        """Work in a number of keyframes; RuntimeError where nothing holds them."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        begin, self._done = self._done, self._done + keyframes
        for k, here in zip(self._order[begin : self._done], self._at[begin : self._done], strict=True):
            self._bring(X0 + k, graph, values)
            for one in here:
                self._push(one, graph, values)
        self.isam.update(graph, values)

    def finish(self, variables: Variables) -> None:
        """The last step: what came since, where the variables are now; RuntimeError where nothing holds it."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key in self._alone:
            self._bring(key, graph, values)
        for one in self._last:
            self._push(one, graph, values)
        variables.insert(self._new, values)
        for factor in self._later:
            graph.push_back(factor)
        self.isam.update(graph, values)
        self.isam.calculateEstimate()  # throws now, if it does

    def _push(self, one: Stored, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        for key in one.keys:
            if key not in self._there:
                self._bring(key, graph, values)
        for factor in one.factors:
            graph.push_back(factor)

    def _bring(self, key: int, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Put in a variable, and what is about it alone."""
        if key in self._there:
            return
        self._there.add(key)
        self._variables.insert([key], values)
        for one in self._alone.get(key, ()):
            self._push(one, graph, values)
