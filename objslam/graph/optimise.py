"""Levenberg-Marquardt and GNC on a factor graph, with what GTSAM throws turned into an error that says what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.errors import SolveError
from objslam.graph.factors import L0, X0
from objslam.types import Floats, Ints

Watch = Callable[[float, gtsam.Values], None]
"""Called after each iteration with the cost and the values that it led to."""


@dataclass(frozen=True)
class Optimum:
    """What an optimisation found; weights: (F,) one for each factor of the graph, for GNC alone."""

    values: gtsam.Values
    cost_before: float
    cost_after: float
    iterations: int
    weights: Floats | None = None


def build_graph(*groups: Sequence[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """One graph of all the factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for group in groups:
        for factor in group:
            graph.push_back(factor)
    return graph


def make_values(map_T_camera: Floats, positions: Floats, landmarks: Ints) -> gtsam.Values:
    """Values with X(0..K-1) at map_T_camera (K, 4, 4), and L(j) at positions[j] for each j of landmarks."""
    values = gtsam.Values()
    for k, pose in enumerate(map_T_camera):
        values.insert(X0 + k, gtsam.Pose3(pose))
    for j in landmarks.tolist():
        values.insert(L0 + j, positions[j])
    return values


def read_poses(values: gtsam.Values) -> Floats:
    """(K, 4, 4) the poses X(0..K-1) of the values, made orthonormal to rounding."""
    flat = gtsam.utilities.extractPose3(values)
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = flat[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = flat[:, 9:]
    return poses


def read_points(values: gtsam.Values) -> Floats:
    """(n, 3) the points of the values in the order of their keys."""
    return np.asarray(gtsam.utilities.extractPoint3(values)).reshape(-1, 3)


def with_points(positions: Floats, landmarks: Ints, values: gtsam.Values) -> Floats:
    """The positions (N, 3) with those of the landmarks (n,) as the values have them."""
    placed = positions.copy()
    placed[landmarks] = read_points(values)
    return placed


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    max_iterations: int,
    relative_tolerance: float = 1e-6,
    watch: Watch | None = None,
) -> Optimum:
    """The minimum from `start`; SolveError when the linear system is indeterminate, naming the variable where GTSAM does."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setAbsoluteErrorTol(1e-12)
    try:
        if watch is not None:
            parameters.iterationHook = lambda number, before, after: watch(float(after), optimizer.values())
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
        before = graph.error(start)
        values = optimizer.optimize()
        after = optimizer.error()
    except RuntimeError as error:
        raise indeterminate(error) from error
    return _finite(Optimum(values, before, after, optimizer.iterations()))


def graduated(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, max_iterations: int, known_inliers: Sequence[int]
) -> Optimum:
    """Graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas, Carlone 2020) over LM.

    known_inliers: indices of the factors that are never rejected (odometry, priors).
    """
    inner = gtsam.LevenbergMarquardtParams()
    inner.setMaxIterations(max_iterations)
    parameters = gtsam.GncLMParams(inner)
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(known_inliers))
    try:
        optimizer = gtsam.GncLMOptimizer(graph, start, parameters)
        optimizer.setInlierCostThresholdsAtProbability(0.999)
        before = graph.error(start)
        values = optimizer.optimize()
        weights = np.asarray(optimizer.getWeights())
        after = float(sum(w * graph.at(i).error(values) for i, w in enumerate(weights) if w > 0))
    except RuntimeError as error:
        raise indeterminate(error) from error
    return _finite(Optimum(values, before, after, 0, weights))


def _finite(optimum: Optimum) -> Optimum:
    if not np.isfinite(optimum.cost_after):
        raise SolveError("the solve ran away: its cost is not finite", hint="is the odometry usable, in metres and radians?")
    return optimum


def indeterminate(error: RuntimeError) -> SolveError:
    """The error for what GTSAM threw: it names the variable that nothing holds, where it says so."""
    said = " ".join(str(error).strip().partition("\n\n")[0].split()) or type(error).__name__
    return SolveError(
        f"the factor graph has no single solution: {said.rstrip('.')}",
        hint="some pose or object is not held by any measurement; a smaller joint.prior_sigma holds every object",
    )
