"""Optimise a factor graph by Levenberg-Marquardt or GNC, and turn GTSAM's exceptions into errors with a hint."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.ground.flattening import LEVEL, raised_points
from objslam.core.statistics import CAUCHY_K, HUBER_K
from objslam.core.trace import Trace
from objslam.errors import SolveError
from objslam.graph.variables import read_poses, with_points

STILL = 5e-3
"""The decrease of the cost below which an iteration ends a joint solve. The cost is half the sum of squared residuals in
standard deviations. A step that decreases the cost by d moves no variable by more than sqrt(2 d) standard deviations of this
variable (Cauchy-Schwarz with the information matrix). Here, sqrt(2 d) is 0.1. A larger value ends a solve sooner."""

OnIteration = Callable[[float, gtsam.Values], None]
"""A function that is called after each iteration with the new cost and the new values."""


@dataclass(frozen=True)
class Optimum:
    """The result of an optimisation. SolveError if its cost is not finite.

    iterations: the number of iterations of Levenberg-Marquardt, 0 for GNC. weights: (F,) the weights of the factors from
    GNC, None without GNC.
    """

    values: gtsam.Values
    cost_before: float
    cost_after: float
    iterations: int
    weights: Floats | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.cost_after):
            raise SolveError(
                "the solve diverged: its cost is not finite", hint="check that the odometry is in metres and radians"
            )

    def ray_weights(self, loss: Loss, residual: Floats) -> Floats:
        """Return the weights (R,) of rays, which are the first factors. residual: (R,) their residuals, in sigmas."""
        if loss == "gnc" and self.weights is not None:
            return self.weights[: len(residual)]
        if loss == "huber":
            return np.minimum(1.0, HUBER_K / np.maximum(residual, 1e-12))
        if loss == "cauchy":
            return 1 / (1 + (residual / CAUCHY_K) ** 2)
        return np.ones(len(residual))


def build_graph(*groups: Sequence[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Return one graph with all factors in their order."""
    graph = gtsam.NonlinearFactorGraph()
    add = graph.add  # It takes a fifth of the time of push_back, which first tests whether the factor is a graph.
    for group in groups:
        for factor in group:
            add(factor)
    return graph


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    loss: Loss,
    settings: Settings,
    known_inliers: Sequence[int],
    tolerance: float = 1e-6,
    on_iteration: OnIteration | None = None,
    still: float = 0.0,
) -> Optimum:
    """Minimise from `start`, by `graduated` for the loss `gnc` and by `levenberg_marquardt` for all other losses.

    known_inliers is for `gnc` only. tolerance, on_iteration and still are for all other losses only.
    """
    if loss == "gnc":
        return graduated(graph, start, settings.joint.max_iterations, known_inliers)
    return levenberg_marquardt(graph, start, settings.joint.max_iterations, tolerance, on_iteration, still)


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    max_iterations: int,
    relative_tolerance: float = 1e-6,
    on_iteration: OnIteration | None = None,
    still: float = 0.0,
) -> Optimum:
    """Minimise by Levenberg-Marquardt. SolveError if the linear system is indeterminate, or if the cost is not finite.

    relative_tolerance: the solve ends if an iteration decreases the cost by less than this share. still: the solve also ends
    if an iteration decreases the cost by less than this amount, for example `STILL`.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setAbsoluteErrorTol(max(still, 1e-12))
    last, running = 0, list[gtsam.LevenbergMarquardtOptimizer]()

    def hook(number: Any, _: Any, after: Any) -> None:
        nonlocal last
        if int(number) > last and on_iteration is not None:  # After a failed step, GTSAM gives the last number again.
            on_iteration(float(after), running[0].values())
        last = int(number)

    try:
        if on_iteration is not None:
            parameters.iterationHook = hook
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
        running.append(optimizer)
        before = optimizer.error()
        values = optimizer.optimize()
    except RuntimeError as error:
        raise indeterminate(error) from error
    finally:
        running.clear()  # The optimizer refers to the hook. A reference back would keep both in memory for ever.
    return Optimum(values, before, optimizer.error(), optimizer.iterations())


def graduated(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, max_iterations: int, known_inliers: Sequence[int]
) -> Optimum:
    """Minimise by graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas, Carlone 2020).

    Each step is a solve by Levenberg-Marquardt. known_inliers: indices of the factors that are never rejected
    (odometry, priors). SolveError if the linear system is indeterminate, or if the cost is not finite.
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
    return Optimum(values, before, after, 0, weights)


def indeterminate(error: RuntimeError) -> SolveError:
    """Return a SolveError that explains an exception of GTSAM. The error names the undetermined variable if GTSAM does."""
    reason = " ".join(str(error).strip().partition("\n\n")[0].split()) or type(error).__name__
    return SolveError(
        f"the factor graph has no single solution: {reason.rstrip('.')}",
        hint="no measurement determines some pose or object; a smaller joint.prior_sigma holds every object",
    )


def trace_solve(
    trace: Trace | None, positions: Floats, landmarks: Ints, fixed: Floats | None = None, scale: float = LEVEL
) -> OnIteration | None:
    """Return a function that records each iteration of a solve in the trace, or None without a trace.

    landmarks: (n,) the solved rows of positions (N, 3). fixed: (K, 4, 4) camera poses that are not solved.
    scale: the factor on z of the world of the solve (`core.ground.flattening`).
    """
    if trace is None:
        return None

    def on_iteration(cost: float, values: gtsam.Values) -> None:
        poses = read_poses(values) if fixed is None else fixed
        trace.iteration("solve", cost, poses, raised_points(with_points(positions, landmarks, values), scale))

    return on_iteration
