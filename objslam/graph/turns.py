"""A large graph built anew in turns, while the old one goes on: no frame has to wait until all of it is done."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from objslam.graph.factors import l_key, x_key
from objslam.graph.kept import Kept
from objslam.types import Floats

_RELINEARISE = (0.02, 0.05)  # rad, m; a variable that moved by more is linearised anew
_EVERY = 1_000_000  # updates, where nobody asks for it: the caller knows when there is time


def new_isam() -> gtsam.ISAM2:
    """An iSAM2 with nothing in it."""
    parameters = gtsam.ISAM2Params()
    turn, way = _RELINEARISE
    limits = gtsam.ISAM2ThresholdMap()
    limits.insert(("x", np.array([turn] * 3 + [way] * 3)))
    limits.insert(("l", np.array([way] * 3)))
    parameters.setRelinearizeThreshold(limits)
    parameters.relinearizeSkip = _EVERY
    return gtsam.ISAM2(parameters)


class Turns:
    """The factors that were kept when it began, keyframe by keyframe; what came since is to be told, and comes last.

    order: keyframes, each after the one that its motion comes from. poses (4, 4) and points (3,): where all are linearised.
    isam: what has been built so far.
    """

    def __init__(self, kept: Kept, order: list[int], poses: Mapping[int, Floats], points: Mapping[int, Floats]) -> None:
        self.isam = new_isam()
        self._kept, self._order, self._poses, self._points = kept, order, poses, points
        self._rays_of: dict[int, list[int]] = {}
        for number, ray in kept.rays.items():
            self._rays_of.setdefault(ray.keyframe, []).append(number)
        self._done = 0
        self._landmarks: set[int] = set()
        self._later: list[gtsam.NonlinearFactor] = []
        self._new_keyframes: list[int] = []
        self._new_landmarks: list[int] = []

    @property
    def last(self) -> bool:
        """Whether the next turn is the last, which takes what came since."""
        return self._done >= len(self._order)

    def add_keyframe(self, k: int) -> None:
        """X(k) came since."""
        self._new_keyframes.append(k)

    def add_landmark(self, j: int) -> None:
        """L(j) came since."""
        self._new_landmarks.append(j)

    def add_factor(self, factor: gtsam.NonlinearFactor) -> None:
        """A factor that came since."""
        self._later.append(factor)

    def turn(self, keyframes: int) -> None:
        """So many keyframes more. RuntimeError where nothing holds them."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        begin, self._done = self._done, self._done + keyframes
        for k in self._order[begin : self._done]:
            values.insert(x_key(k), gtsam.Pose3(self._poses[k]))
            motion = self._kept.chain.get(k)
            if motion is not None:
                keys = motion.keys()
                known = all(values.exists(key) or self.isam.valueExists(key) for key in keys)
                graph.push_back(motion) if known else self._later.append(motion)
            if k in self._kept.absolute:
                graph.push_back(self._kept.absolute[k])
            for number in self._rays_of.get(k, ()):
                ray = self._kept.rays[number]
                self._bring(ray.landmark, graph, values)
                for factor in ray.factors:
                    graph.push_back(factor)
        self.isam.update(graph, values)

    def finish(self, poses: Mapping[int, Floats], points: Mapping[int, Floats]) -> None:
        """The last turn: what came since, at those poses (4, 4) and points (3,). RuntimeError where nothing holds it."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for j in self._kept.landmarks:
            self._bring(j, graph, values)
        for k in self._new_keyframes:
            values.insert(x_key(k), gtsam.Pose3(poses[k]))
        for j in self._new_landmarks:
            values.insert(l_key(j), points[j])
        for factor in self._later:
            graph.push_back(factor)
        self.isam.update(graph, values)
        self.isam.calculateEstimate()  # throws now, if it does

    def _bring(self, j: int, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        if j not in self._landmarks:
            self._landmarks.add(j)
            values.insert(l_key(j), self._points[j])
            graph.push_back(self._kept.landmarks[j])
