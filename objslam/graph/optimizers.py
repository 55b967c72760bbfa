"""Levenberg-Marquardt and GNC on a factor graph, with what GTSAM throws turned into an error that says what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.trace import Trace
from objslam.errors import SolveError
from objslam.graph.variables import read_poses, with_points

OnIteration = Callable[[float, gtsam.Values], None]
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


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    loss: Loss,
    settings: Settings,
    known_inliers: Sequence[int],
    tolerance: float = 1e-6,
    on_iteration: OnIteration | None = None,
) -> Optimum:
    """The minimum from `start` by the optimiser that the loss asks for, as `graduated` or `levenberg_marquardt` has it."""
    if loss == "gnc":
        return graduated(graph, start, settings.joint.max_iterations, known_inliers)
    return levenberg_marquardt(graph, start, settings.joint.max_iterations, tolerance, on_iteration)


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    max_iterations: int,
    relative_tolerance: float = 1e-6,
    on_iteration: OnIteration | None = None,
) -> Optimum:
    """The minimum that Levenberg-Marquardt finds from `start`.

    SolveError when the linear system is indeterminate. It names the variable if GTSAM does.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setAbsoluteErrorTol(1e-12)
    try:
        if on_iteration is not None:
            parameters.iterationHook = lambda number, before, after: on_iteration(float(after), optimizer.values())
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


def trace_solve(trace: Trace | None, positions: Floats, landmarks: Ints, fixed: Floats | None = None) -> OnIteration | None:
    """What traces a solve of some landmarks (n,) among the positions (N, 3); fixed: camera poses that are not solved."""
    if trace is None:
        return None

    def on_iteration(cost: float, values: gtsam.Values) -> None:
        poses = read_poses(values) if fixed is None else fixed
        trace.iteration("solve", cost, poses, with_points(positions, landmarks, values))

    return on_iteration
