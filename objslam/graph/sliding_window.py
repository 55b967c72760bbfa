"""Solve a graph that grows along the path, over a window of its last keyframes. Priors replace the rest of the graph.

If each step solved the whole graph, the time would grow with the square of the path. So a step solves only the window. The
whole graph is solved each time its size has doubled. All whole solves together take twice the time of the last one.
"""

from typing import Self

import gtsam
import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.graph.assembly import Measurements
from objslam.graph.optimizers import Optimum, build_graph, levenberg_marquardt
from objslam.graph.variables import L0, LETTER, X0, keyframes_in, landmarks_in

_WINDOW = 60
"""The number of earlier keyframes that a step solves again. A larger number is slower and corrects older poses. On the
MRCLAM robots, windows of 30, 60 and 120 keyframes lead to the same maps."""
_GROWTH = 2.0
"""The factor by which the graph grows between two solves of the whole graph. A larger factor is faster. A window ignores the
correlations between the errors of its priors, and the changes of old poses by a loop. A smaller factor corrects both
sooner."""
_AT_CAMERA = 1e-3
"""The distance (m) from a camera below which a landmark is wrong and leaves the graph. Below this distance, the information
of a bearing is so large that the linear system becomes singular. The solver moved landmarks to a camera on real drives whose
clocks were 0.2 s apart. A larger distance also removes real landmarks."""


class SlidingWindow:
    """Camera poses map_T_camera (K, 4, 4) and landmark positions (N, 3), in map, of a graph that grows along the path.

    A landmark that is not in the graph yet has the position NaN. The graph has the keyframes before `end`. The last whole
    solve had the keyframes before `solved`.
    """

    def __init__(self, measured: Measurements, owner: Ints, landmarks: int) -> None:
        """Start with the first keyframe. owner: (R,) the landmark of each ray. The caller may change its later entries."""
        self.map_T_camera = measured.keyframes.map_T_camera.copy()
        self.positions = np.full((landmarks, 3), np.nan)
        self._measured, self._owner = measured, owner
        self._factors: list[list[gtsam.NonlinearFactor]] = [[] for _ in self.map_T_camera]  # By their last keyframe.
        self._weak: dict[int, gtsam.NonlinearFactor] = {}  # The weak prior of each landmark, by its key.
        self._held: dict[int, gtsam.NonlinearFactor] = {}  # By key: the prior in place of factors outside the window.
        self._values = gtsam.Values()
        self._begin, self.end, self.solved = 0, 0, 0  # The window's ends, and `end` at the last whole solve.
        nothing = np.zeros(0, dtype=np.int64)
        self.extend(1, nothing, nothing, np.zeros((0, 3, 3)))

    def extend(self, end: int, rays: Ints, born: Ints, covariance: Floats) -> None:
        """Add the keyframes before `end`, rays (n,) and landmarks `born` (m,). The poses and positions must be set already.

        covariance: (m, 3, 3) m^2 of the landmarks. If a landmark has rays from before the window, this covariance becomes
        its prior.
        """
        keyframe = self._measured.rays.keyframe
        for factor in self._measured.factors(self._owner, rays, born, self.positions, begin=self.end, end=end):
            last = max(factor.keys())  # A keyframe if there is one, because its key is above those of landmarks.
            if _is_landmark(last):
                self._weak[last] = factor
            else:
                self._factors[last - X0].append(factor)
        for k in range(self.end, end):
            self._values.insert(X0 + k, gtsam.Pose3(self.map_T_camera[k]))
        left = np.isin(born, self._owner[rays[keyframe[rays] < self._begin]])
        for j, spread, older in zip(born.tolist(), covariance, left.tolist(), strict=True):
            self._values.insert(L0 + j, self.positions[j])
            if older:
                self._held[L0 + j] = _prior(L0 + j, self._values, spread)
        self.end = end

    def regrown(self, owner: Ints, positions: Floats, map_T_camera: Floats) -> Self:
        """Return a window at the same keyframes with other landmarks and poses (K, 4, 4). Its next solve is of the whole
        graph.

        owner: (R,) the landmark of each ray. positions: (N, 3) m, all finite.
        """
        other = type(self)(self._measured, owner, len(positions))
        other.map_T_camera[:], other.positions = map_T_camera, positions
        held = np.flatnonzero((owner >= 0) & (self._measured.rays.keyframe < self.end))
        other.extend(self.end, held, np.arange(len(positions)), np.zeros((len(positions), 3, 3)))
        return other

    def whole(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the whole graph and its values."""
        graph = build_graph(*self._factors[: self.end], list(self._weak.values()))
        return graph, self._values

    def solve(self, iterations: int, whole: bool = False) -> Optimum:
        """Solve the window by at most `iterations` iterations. Then move the window on.

        The whole graph is solved if the caller asks for it, or if the graph has grown enough or is complete.

        A landmark that ends at a camera (`_AT_CAMERA`) leaves the graph, its position becomes NaN, and new rays may find it
        again. SolveError if the linear system is indeterminate, or if the cost is not finite.
        """
        if whole or self.end >= _GROWTH * self.solved or self.end == len(self.map_T_camera):
            self._begin, self.solved, self._held = 0, self.end, {}
        graph = self._graph(self._begin, self.end)
        optimum = levenberg_marquardt(graph, self._values.extract(graph.keyVector()), iterations, 1e-4)
        self._values.update(optimum.values)
        keyframes, poses = keyframes_in(optimum.values)
        landmarks, points = landmarks_in(optimum.values)
        self.map_T_camera[keyframes], self.positions[landmarks] = poses, points
        self._take_out(landmarks[_at_a_point(points, poses[:, :3, 3])])
        if self.end < len(self.map_T_camera):
            self._move(max(self.end - _WINDOW, self._begin))
        return optimum

    def _take_out(self, landmarks: Ints) -> None:
        """Remove landmarks (n,) and their factors from the graph."""
        if not len(landmarks):
            return
        out = set((L0 + landmarks).tolist())
        self._factors = [[one for one in factors if out.isdisjoint(one.keys())] for factors in self._factors]
        for key in out:
            self._weak.pop(key, None)
            self._held.pop(key, None)
            self._values.erase(key)
        self.positions[landmarks] = np.nan

    def _graph(self, begin: int, end: int) -> gtsam.NonlinearFactorGraph:
        """Return the graph of the keyframes from `begin` to `end` - 1, with the priors of its variables."""
        graph = build_graph(*self._factors[begin:end])
        keys = graph.keyVector()
        priors = [self._held.get(key, self._weak.get(key)) for key in keys]
        graph.push_back(build_graph([prior for prior in priors if prior is not None]))
        return graph

    def _move(self, begin: int) -> None:
        """Let the window begin at a later keyframe. The marginals of the removed part become priors of the window.

        A landmark that leaves the window keeps its marginal. The marginal is its prior when the landmark is seen again. If
        the marginals are indeterminate, nothing changes.
        """
        if begin == self._begin:
            return
        leaving = self._graph(self._begin, begin)
        keys = leaving.keyVector()
        staying = set(self._graph(begin, self.end).keyVector())
        kept = [key for key in keys if _is_landmark(key) or key in staying]
        try:
            marginals = gtsam.Marginals(leaving, self._values.extract(keys))
            self._held |= {key: _prior(key, self._values, marginals.marginalCovariance(key)) for key in kept}
        except RuntimeError:  # The system is indeterminate.
            return
        self._begin = begin


def _at_a_point(positions: Floats, points: Floats) -> Bools:
    """Return which positions (N, 3) are at one of the points (K, 3), K > 0.

    Only points that are near along the longest axis of the path are compared. A search tree would do the same, but the
    import of scipy.spatial takes 0.07 s.
    """
    axis = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, axis])
    first, last = (np.searchsorted(points[order, axis], positions[:, axis] + side) for side in (-_AT_CAMERA, _AT_CAMERA))
    number = last - first
    which = np.repeat(np.arange(len(positions)), number)
    beside = order[np.arange(len(which)) + np.repeat(first - np.cumsum(number) + number, number)]
    at_it = np.linalg.norm(positions[which] - points[beside], axis=1) < _AT_CAMERA
    return np.bincount(which[at_it], minlength=len(positions)) > 0


def _is_landmark(key: int) -> bool:
    return key >> LETTER == L0 >> LETTER


def _prior(key: int, values: gtsam.Values, covariance: Floats) -> gtsam.NonlinearFactor:
    """Return the factor that holds a variable at its value, with a covariance (3, 3) or (6, 6)."""
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if _is_landmark(key):
        return gtsam.PriorFactorPoint3(key, values.atPoint3(key), noise)
    return gtsam.PriorFactorPose3(key, values.atPose3(key), noise)
