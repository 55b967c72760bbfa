"""Rebuild a large iSAM2 graph in slices, while the old graph stays in use, so that no image waits for the whole rebuild."""

from collections.abc import Mapping

import gtsam
import numpy as np

from objslam.core.arrays import Floats
from objslam.graph.factor_store import FactorStore, Stored
from objslam.graph.variables import LETTER, X0, Variables

_RELINEARISE = (0.02, 0.05)
"""The changes (rad, m) of a variable above which its factors are linearised again. Larger values are faster and less exact.
A change below these values has no noticeable effect on a bearing."""
_NEVER = 1_000_000
"""The number of updates between two automatic relinearisations. It is so large that none happens, because the caller asks
for a relinearisation when there is time. With a smaller number, iSAM2 relinearises without a request."""


def new_isam(others: Mapping[int, gtsam.Pose3 | Floats]) -> gtsam.ISAM2:
    """Return an empty iSAM2 that knows the letters of poses X, points L, and the other variables (by key)."""
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
    """The construction of a new iSAM2. The new iSAM2 gets the stored factors keyframe by keyframe. At the end, it gets the
    factors and variables that the old graph got in the meantime.

    order: the keyframes in the order in which they are added. The keyframe at the start of a motion comes before the one at
    its end. variables: the linearisation points. isam: the new iSAM2 so far. new: the keys of the variables that came after
    the start of the rebuild. later: the factors that came after the start.
    """

    def __init__(self, store: FactorStore, order: list[int], variables: Variables) -> None:
        self.isam = new_isam(variables.others)
        self._store, self._variables, self._order = store, variables, order
        self._sorted = False
        self._at: list[list[Stored]] = [[] for _ in order]  # Factors by their last keyframe in the order.
        self._alone: dict[int, list[Stored]] = {}  # Factors on a single variable that is not a keyframe.
        self._last: list[Stored] = []  # Factors on several variables without a keyframe.
        self._done = 0
        self._there: set[int] = set()
        self.later = gtsam.NonlinearFactorGraph()
        self.new: list[int] = []

    @property
    def last(self) -> bool:
        """Whether the next step is `finish`."""
        return self._done >= len(self._order)

    def step(self, keyframes: int) -> None:
        """Add the next `keyframes` keyframes and their factors. RuntimeError if the graph is indeterminate."""
        self._sort()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        begin, self._done = self._done, self._done + keyframes
        for k, here in zip(self._order[begin : self._done], self._at[begin : self._done], strict=True):
            self._bring(X0 + k, graph, values)
            for one in here:
                self._push(one, graph, values)
        self.isam.update(graph, values)

    def finish(self, variables: Variables) -> None:
        """Add the later variables at their values in `variables`, and all other factors. RuntimeError if indeterminate."""
        self._sort()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key in self._alone:
            self._bring(key, graph, values)
        for one in self._last:
            self._push(one, graph, values)
        variables.insert(self.new, values)
        graph.push_back(self.later)
        self.isam.update(graph, values)
        self.isam.calculateEstimate()  # It raises here if the graph is indeterminate.

    def _sort(self) -> None:
        """Sort the factors by the step that adds them. The first step calls this method. The start of a rebuild does not
        call it, because other work on the same image has already taken time."""
        if self._sorted:
            return
        self._sorted = True
        place = {X0 + k: i for i, k in enumerate(self._order)}
        for stored in self._store.kinds.values():
            for one in stored.values():
                at = max([place.get(key, -1) for key in one.keys])
                if at >= 0:
                    self._at[at].append(one)
                elif len(one.keys) == 1:
                    self._alone.setdefault(next(iter(one.keys)), []).append(one)
                else:
                    self._last.append(one)

    def _push(self, one: Stored, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        for key in one.keys:
            self._bring(key, graph, values)
        for factor in one.factors:
            graph.push_back(factor)

    def _bring(self, key: int, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Add a variable and the factors on it alone, unless the variable is in the graph already."""
        if key in self._there:
            return
        self._there.add(key)
        self._variables.insert([key], values)
        for one in self._alone.get(key, ()):
            self._push(one, graph, values)
