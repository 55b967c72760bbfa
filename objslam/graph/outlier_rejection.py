"""Reject outliers: solve, test every ray, and repeat until the inliers stay the same."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import angles_off
from objslam.core.statistics import MOST_NOISE_FACTOR, NOISE_MEASURED_BY, OUTLIER_RAY, STRAY_RAY, noise_factors
from objslam.core.trace import Trace
from objslam.core.types import Association, Rays
from objslam.graph.assembly import Measurements
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.graph.least_squares.gauss_newton import Solution, gauss_newton
from objslam.graph.least_squares.joint_rows import JointGraph
from objslam.graph.least_squares.normal_equations import Equations
from objslam.graph.optimizers import STILL, Optimum, optimize, trace_solve
from objslam.graph.robust_cost import truncated_cost
from objslam.graph.variables import read_poses, with_points

_BESIDE, _MOST = 5, 0.6
"""The stretch of a ray goes from `_BESIDE` rays before it to `_BESIDE` rays after it. A rejected ray gets a second chance if
at least the share `_MOST` of the rays in its stretch is rejected, because the poses of the stretch may be wrong. A few false
boxes in a row get no second chance. Larger values restore fewer rays."""
ROUNDS = 4
"""The largest number of rounds of solve and test. More rounds are slower, and late rounds change few rays."""
_COARSE = 1e-4
"""A solve before a test of inliers ends if an iteration decreases the cost by less than this share. Robust losses converge
slowly, and a more exact solution hardly changes which rays are inliers. A larger value is faster."""
_SURE = 0.95
"""The share of inliers among the rays of an object below which the object is triangulated again. A larger share is slower,
and corrects more objects at wrong positions."""


Near = tuple[Ints, Equations]
"""The landmarks (m,) of a graph with Huber's loss, and its normal equations near the optimum."""


@dataclass(frozen=True)
class JointSolution:
    """A solution for poses and objects. map_T_camera: (K, 4, 4). positions: (N, 3) m. used: (R,) whether a ray is an
    inlier. near: the landmarks (m,) and the normal equations of the last solve on arrays, None if there was none."""

    map_T_camera: Floats
    positions: Floats
    used: Bools
    optimum: Optimum
    cost_before: float
    iterations: int
    near: Near | None = None


def reject_outliers(
    measured: Measurements,
    association: Association,
    map_T_camera: Floats,
    positions: Floats,
    used: Bools,
    back: Bools,
    trace: Trace | None,
    tolerance: float = 1e-6,
    rounds: int = ROUNDS,
    near: Near | None = None,
    close: bool = False,
) -> JointSolution:
    """Solve, and test which rays agree with their objects, until the inliers stay the same, or at most `rounds` times.

    map_T_camera (K, 4, 4) and positions (N, 3): the start. An unknown position is NaN. used: (R,) the inliers of an earlier
    solve, or all False. back: (R,) rays that are inliers in the first solve, whatever the test says. tolerance: the last
    solve ends if the cost decreases by less than this share. Earlier solves end at `_COARSE` if `_COARSE` is larger. If
    `used` has inliers, the first solve already ends at `tolerance`, because such inliers seldom change. near: the normal
    equations of a solve on arrays that ended near the start. Solves on arrays use them first. close: whether the start is
    near the optimum, because it is the solution of nearly the same measurements. If so, even the first solve is on arrays.
    """
    optimum, cost_before, iterations = None, np.nan, 0
    limit = tolerance if used.any() else max(tolerance, _COARSE)
    if measured.tags is not None:
        positions = measured.tags.placed(measured.rays, map_T_camera, positions)
    solver = _Solver(measured, association, trace, near, close)
    enough = np.full(association.count, np.iinfo(np.int64).max)
    for _ in range(rounds):
        moved, agreeing, enough = second_opinion(measured, map_T_camera, association, positions, used, enough)
        if optimum is None:
            agreeing = agreeing | back
        elif (agreeing == used).all():
            break  # These inliers are solved already.
        positions, used = moved, agreeing
        map_T_camera, positions, optimum = solver.solve(map_T_camera, positions, used, limit)
        cost_before = optimum.cost_before if np.isnan(cost_before) else cost_before
        iterations += optimum.iterations
    assert optimum is not None
    if tolerance < limit and measured.settings.joint.loss != "gnc":
        map_T_camera, positions, optimum = solver.solve(map_T_camera, positions, used, tolerance, optimum)
        iterations += optimum.iterations
    return JointSolution(map_T_camera, positions, used, optimum, cost_before, iterations, solver.near)


@dataclass
class _Solver:
    """Solves the graph of the same measurements for different inliers.

    If the first solve starts far from the optimum, GTSAM solves it, by Levenberg-Marquardt. Other solves are on arrays,
    which takes less time than the construction of a graph of GTSAM. near: as in `JointSolution`. close: whether the next
    solve starts near its optimum. graph: the last graph of GTSAM.
    """

    measured: Measurements
    association: Association
    trace: Trace | None
    near: Near | None
    close: bool
    graph: gtsam.NonlinearFactorGraph | None = None

    def solve(
        self, map_T_camera: Floats, positions: Floats, used: Bools, tolerance: float, last: Optimum | None = None
    ) -> tuple[Floats, Floats, Optimum]:
        """Return poses (K, 4, 4), positions (N, 3) and the optimum for the inliers `used` (R,).

        The optimum of a solve on arrays has no values of GTSAM. If a solve on arrays ends before an optimum, GTSAM goes on
        from there, and names a variable that is not determined. last: the optimum of the same inliers, from which GTSAM goes
        on.
        """
        steps, loss, settings = 0, self.measured.settings.joint.loss, self.measured.settings
        if self.close and loss == "huber" and self.measured.tags is None:
            found, positions = self._on_arrays(map_T_camera, positions, used, tolerance)
            map_T_camera, steps = found.map_T_camera, found.steps
            if found.ended:
                return map_T_camera, positions, Optimum(gtsam.Values(), found.cost_before, found.cost_after, steps)
        self.close = True
        if last is None or self.graph is None:
            self.graph, values = self.measured.whole(self.association.object, used, map_T_camera, positions, loss)
        else:
            values = last.values
        landmarks, others = known_landmarks(positions), range(int(used.sum()), self.graph.size())
        traced = trace_solve(self.trace, positions, landmarks)
        optimum = optimize(self.graph, values, loss, settings, others, tolerance, traced, STILL)
        optimum = replace(optimum, iterations=steps + optimum.iterations)
        return read_poses(optimum.values), with_points(positions, landmarks, optimum.values), optimum

    def _on_arrays(self, map_T_camera: Floats, positions: Floats, used: Bools, tolerance: float) -> tuple[Solution, Floats]:
        """Return where the solve on arrays ends, and its positions (N, 3)."""
        graph = JointGraph.of(self.measured, self.association, used, positions)
        normal = None if self.near is None or not np.array_equal(self.near[0], graph.landmarks) else self.near[1]

        def placed(landmarks: Floats) -> Floats:
            moved = positions.copy()
            moved[graph.landmarks] = landmarks
            return moved

        def on_step(cost: float, poses: Floats, landmarks: Floats) -> None:
            if self.trace is not None:
                self.trace.iteration("solve", cost, poses, placed(landmarks))

        most = self.measured.settings.joint.max_iterations
        found = gauss_newton(graph, map_T_camera, normal, most, tolerance, STILL, on_step)
        self.near = None if found.normal is None else (graph.landmarks, found.normal)
        self.graph = None  # A graph of GTSAM had other inliers.
        return found, placed(found.landmarks)


def known_landmarks(positions: Floats) -> Ints:
    """Return the landmarks (m,) with a position. An unknown position (N, 3) is NaN."""
    return np.flatnonzero(np.isfinite(positions[:, 0]))


def order_near(near: Near | None, landmarks: Ints) -> Ints | None:
    """Return the order of elimination (D,) of a solve that had these landmarks (m,). None for other landmarks or a chain."""
    return near[1].order if near is not None and np.array_equal(near[0], landmarks) else None


def rejected_stretches(rays: Rays, association: Association, found: JointSolution) -> Bools:
    """Return a mask (R,) of the rejected rays whose neighbours in time are also mostly rejected."""
    order = np.flatnonzero(np.isin(association.object, np.flatnonzero(np.isfinite(found.positions[:, 0]))))
    order = order[np.argsort(rays.keyframe[order], kind="stable")]
    rejected, window = ~found.used[order], np.ones(2 * _BESIDE + 1)
    back = np.zeros(len(rays), dtype=bool)
    if len(order) >= len(window):
        near, share = (np.convolve(which, window, mode="same") for which in (np.ones(len(order)), rejected))
        back[order] = rejected & (share >= _MOST * near)
    return back


def misfit(map_T_camera: Floats, positions: Floats, measured: Measurements, association: Association) -> float:
    """Return the cost of camera poses (K, 4, 4) and positions (N, 3), to compare two solutions of the same rays.

    A ray to an object at an unknown position (NaN) costs `STRAY_RAY`.
    """
    placed = np.isfinite(positions[:, 0])
    owner = np.where((association.object >= 0) & placed[association.object], association.object, -1)
    strays = int(((association.object >= 0) & (owner < 0)).sum())
    return STRAY_RAY * strays + truncated_cost(measured.rays, owner, positions, map_T_camera, *measured.odometry())


def second_opinion(
    measured: Measurements, map_T_camera: Floats, association: Association, positions: Floats, used: Bools, enough: Ints
) -> tuple[Floats, Bools, Ints]:
    """Triangulate undetermined objects and objects with outliers again. Keep a new position if more rays agree with it.

    Corners of fiducials keep their positions, because four corners of one square are better known than four separate points.
    An object also keeps its position if at least `enough` (N,) of its rays agree. With this number of agreeing rays, an
    earlier new position was not better. Return the positions (N, 3) m, whether each ray (R,) agrees with its object, and
    `enough` for the next call.
    """
    keyframes, rays = measured.keyframes, measured.rays
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)
    agreeing = supported(rays, association, map_T_camera, positions, used)
    support = np.bincount(association.object[agreeing], minlength=association.count)
    doubtful = (support < _SURE * number) & (support < enough)
    if measured.tags is not None:
        doubtful &= ~measured.tags.is_corner()
    which = np.isin(association.object, np.flatnonzero(doubtful))
    if not which.any():
        return positions, agreeing, enough
    objects, index = np.unique(association.object[which], return_inverse=True)
    some = Association(index, association.label[objects])
    if used.any():  # Solved poses no longer have the noise of the localisation.
        keyframes = replace(keyframes, localized_every=0.0)
    placed = triangulate_at(map_T_camera, keyframes, rays.take(which), some, measured.settings)
    other = positions.copy()
    other[objects[placed.ok]] = placed.positions[placed.ok]
    agreeing = supported(rays, association, map_T_camera, other, used)
    better = np.bincount(association.object[agreeing], minlength=len(support)) > support
    positions = np.where(better[:, None], other, positions)
    enough = np.where(doubtful & ~better & (support > 0), support, enough)
    return positions, supported(rays, association, map_T_camera, positions, used), enough


def supported(rays: Rays, association: Association, map_T_camera: Floats, positions: Floats, used: Bools) -> Bools:
    """Return which rays (R,) agree with their object, given the noise of the object's inliers.

    used: (R,) the inliers. If there are none at all, all rays count as inliers. A camera does not see an object within
    `MIN_DEPTH` of itself. There, the information of a bearing is so large that the linear system becomes singular.
    """
    placed = np.isin(association.object, np.flatnonzero(np.isfinite(positions[:, 0])))
    landmark = association.object[placed]
    origins, directions = (a[placed] for a in rays.in_map(map_T_camera))
    miss = angles_off(origins, directions, positions[landmark]) / rays.sigma[placed]
    before = used[placed] if used.any() else np.ones(len(miss), dtype=bool)
    noise = np.minimum(
        noise_factors(miss[before], landmark[before], association.count, NOISE_MEASURED_BY), MOST_NOISE_FACTOR
    )
    agreeing = np.zeros(len(rays), dtype=bool)
    apart = np.linalg.norm(positions[landmark] - origins, axis=1) > MIN_DEPTH
    agreeing[placed] = apart & (miss <= OUTLIER_RAY * noise[landmark])
    return agreeing
