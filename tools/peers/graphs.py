"""Solve a drive: by a plain GTSAM script, by Python factors, by scipy, and by objslam. Each returns its times and its
landmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from objslam.config import load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from peers.drives import Drive

Solved = tuple[float, float, Floats]
"""The CPU seconds to build and to solve, and the landmarks (N, 2), m, NaN where there is none."""
_MOST_CUSTOM = 20_000
"""The most observations for Python factors, whose time grows with their square. More take minutes an iteration."""
_FIRST = 1e-4
"""The noise (m, rad) of the first pose, which fixes the frame of the map."""


def first_guess(drive: Drive) -> Floats:
    """Return the landmarks (N, 2) where their first observation puts them, from dead reckoning."""
    points = np.zeros((drive.count, 2))
    landmark, at = np.unique(drive.landmark, return_index=True)
    x, y, yaw = drive.poses[drive.frame[at]].T
    angle = yaw + drive.bearing[at]
    points[landmark] = np.column_stack([x + drive.range[at] * np.cos(angle), y + drive.range[at] * np.sin(angle)])
    return points


def _measured_steps(drive: Drive) -> Floats:
    """(F-1, 3) the steps between the poses, each in the frame of the pose before it."""
    step, yaw = np.diff(drive.poses, axis=0), drive.poses[:-1, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1], step[:, 2]])


def _graph(drive: Drive, observation: Callable[..., gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Return the prior of the first pose, then a factor for each step, then one for each observation."""
    graph = gtsam.NonlinearFactorGraph()
    x, landmark0 = gtsam.symbol("x", 0), gtsam.symbol("l", 0)
    graph.add(gtsam.PriorFactorPose2(x, gtsam.Pose2(*drive.poses[0]), gtsam.noiseModel.Isotropic.Sigma(3, _FIRST)))
    for k, (step, sigma) in enumerate(zip(_measured_steps(drive), drive.noise, strict=True)):
        model = gtsam.noiseModel.Diagonal.Sigmas(sigma)
        graph.add(gtsam.BetweenFactorPose2(x + k, x + k + 1, gtsam.Pose2(*step), model))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([drive.bearing_noise, drive.range_noise]))
    columns = (drive.frame.tolist(), drive.landmark.tolist(), drive.bearing.tolist(), drive.range.tolist())
    for k, j, bearing, distance in zip(*columns, strict=True):
        graph.add(observation(x + k, landmark0 + j, bearing, distance, noise))
    return graph


def _compiled(pose: int, point: int, bearing: float, distance: float, noise: Any) -> gtsam.NonlinearFactor:
    return gtsam.BearingRangeFactor2D(pose, point, gtsam.Rot2(bearing), distance, noise)


def _plain(drive: Drive, observation: Callable[..., gtsam.NonlinearFactor]) -> Solved:
    begin = time.process_time()
    graph, values = _graph(drive, observation), gtsam.Values()
    x, landmark0 = gtsam.symbol("x", 0), gtsam.symbol("l", 0)
    for k, pose in enumerate(drive.poses):
        values.insert(x + k, gtsam.Pose2(*pose))
    guess = first_guess(drive)
    seen = np.unique(drive.landmark).tolist()
    for j in seen:
        values.insert(landmark0 + j, guess[j])
    built = time.process_time()
    points = _optimum(drive, graph, values)
    return built - begin, time.process_time() - built, points


def _optimum(drive: Drive, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Floats:
    """Return the landmarks (N, 2), m, where Levenberg-Marquardt ends from these values."""
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    points, seen, landmark0 = np.full((drive.count, 2), np.nan), np.unique(drive.landmark), gtsam.symbol("l", 0)
    points[seen] = [result.atPoint2(landmark0 + j) for j in seen.tolist()]
    return points


def plain_gtsam(drive: Drive) -> Solved:
    """Compiled factors, from dead reckoning, by Levenberg-Marquardt with the settings it comes with."""
    return _plain(drive, _compiled)


def isam2_gtsam(drive: Drive) -> Solved:
    """The same factors, one frame after the other in iSAM2, and Levenberg-Marquardt from there.

    Each frame begins at the solution of those before it. So an odometry that drifts by half a turn leads to no wrong
    minimum, as it does in a batch from dead reckoning.
    """
    begin = time.process_time()
    graph, steps = _graph(drive, _compiled), _measured_steps(drive)
    x, landmark0, frames = gtsam.symbol("x", 0), gtsam.symbol("l", 0), len(drive.poses)
    order = np.argsort(drive.frame, kind="stable")
    first = np.searchsorted(drive.frame[order], np.arange(frames + 1)).tolist()
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.05)
    parameters.relinearizeSkip = 1
    solver, pose = gtsam.ISAM2(parameters), gtsam.Pose2(*drive.poses[0])
    built, found = time.process_time(), set[int]()
    for k in range(frames):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.push_back(graph.at(k))
        pose = pose if k == 0 else pose.compose(gtsam.Pose2(*steps[k - 1]))
        values.insert(x + k, pose)
        for i in order[first[k] : first[k + 1]].tolist():
            factors.push_back(graph.at(frames + i))
            mark, bearing, distance = int(drive.landmark[i]), drive.bearing[i], drive.range[i]
            if mark not in found:
                found.add(mark)
                seen = distance * np.array([np.cos(bearing), np.sin(bearing)])
                values.insert(landmark0 + mark, np.asarray(pose.transformFrom(seen)))
        solver.update(factors, values)
        if first[k + 1] > first[k]:
            solver.update()
        pose = solver.calculateEstimatePose2(x + k)
    points = _optimum(drive, graph, solver.calculateEstimate())
    return built - begin, time.process_time() - built, points


def custom_gtsam(drive: Drive) -> Solved | str:
    """The same graph, with each observation as a `gtsam.CustomFactor` in Python."""
    if len(drive.frame) > _MOST_CUSTOM:
        return f"more than {_MOST_CUSTOM} observations take minutes an iteration"

    def observation(pose: int, point: int, bearing: float, distance: float, noise: Any) -> gtsam.NonlinearFactor:
        def error(this: Any, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
            at, to = values.atPose2(this.keys()[0]), values.atPoint2(this.keys()[1])
            dx, dy = to - at.translation()
            squared = dx * dx + dy * dy
            length = np.sqrt(squared)
            if jacobians is not None:
                c, s = np.cos(at.theta()), np.sin(at.theta())
                by_point = np.array([[-dy / squared, dx / squared], [dx / length, dy / length]])
                jacobians[0] = np.column_stack([-by_point @ [[c, -s], [s, c]], [-1.0, 0.0]])
                jacobians[1] = by_point
            off = np.arctan2(dy, dx) - at.theta() - bearing
            return np.array([(off + np.pi) % (2 * np.pi) - np.pi, length - distance])

        return gtsam.CustomFactor(noise, [pose, point], error)

    return _plain(drive, observation)


def scipy_sparse(drive: Drive) -> Solved:
    """`scipy.optimize.least_squares` with an exact sparse Jacobian."""
    begin = time.process_time()
    frames, said = len(drive.poses), _measured_steps(drive)
    frame, mark = drive.frame, drive.landmark
    start = np.concatenate([drive.poses.ravel(), first_guess(drive).ravel()])
    steps, seen = np.arange(frames - 1), np.arange(len(frame))
    first_seen, rows = 3 * frames, 3 * frames + 2 * len(frame)

    def wrapped(angle: Floats) -> Floats:
        return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)

    def parts(x: Floats) -> tuple[Floats, ...]:
        poses, points = x[: 3 * frames].reshape(-1, 3), x[3 * frames :].reshape(-1, 2)
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        return poses, c, s, np.diff(poses, axis=0), points[mark] - poses[frame, :2]

    def residual(x: Floats) -> Floats:
        poses, c, s, d, to = parts(x)
        moved = np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]]) - said
        moved[:, 2] = wrapped(moved[:, 2])
        off = wrapped(np.arctan2(to[:, 1], to[:, 0]) - poses[frame, 2] - drive.bearing) / drive.bearing_noise
        far = (np.hypot(*to.T) - drive.range) / drive.range_noise
        return np.concatenate(
            [(poses[0] - drive.poses[0]) / _FIRST, (moved / drive.noise).ravel(), np.column_stack([off, far]).ravel()]
        )

    def jacobian(x: Floats) -> csr_matrix:
        _, c, s, d, to = parts(x)
        squared, entries = (to**2).sum(axis=1), []
        length = np.sqrt(squared)

        def put(row: Any, column: Any, value: Floats) -> None:
            entries.append((row, column, value))

        put(np.arange(3), np.arange(3), np.full(3, 1 / _FIRST))
        a, b, t = drive.noise.T
        row, one, two = 3 + 3 * steps, 3 * steps, 3 * steps + 3
        for k, (across, along, turned) in enumerate(
            ((c / a, s / a, (-s * d[:, 0] + c * d[:, 1]) / a), (-s / b, c / b, (-c * d[:, 0] - s * d[:, 1]) / b))
        ):
            for base, sign in ((one, -1), (two, 1)):
                put(row + k, base, sign * across)
                put(row + k, base + 1, sign * along)
            put(row + k, one + 2, turned)
        put(row + 2, one + 2, -1 / t)
        put(row + 2, two + 2, 1 / t)
        row, pose, point = first_seen + 2 * seen, 3 * frame, 3 * frames + 2 * mark
        by = (
            (-to[:, 1] / squared / drive.bearing_noise, to[:, 0] / squared / drive.bearing_noise),
            (to[:, 0] / length / drive.range_noise, to[:, 1] / length / drive.range_noise),
        )
        for k in (0, 1):
            for axis in (0, 1):
                put(row + k, point + axis, by[k][axis])
                put(row + k, pose + axis, -by[k][axis])
        put(row, pose + 2, np.full(len(frame), -1 / drive.bearing_noise))
        r, col, v = (np.concatenate(part) for part in zip(*entries, strict=True))
        return csr_matrix((v, (r, col)), shape=(rows, len(x)))

    built = time.process_time()
    solved = least_squares(residual, start, jacobian, method="trf", x_scale="jac", max_nfev=100)
    points = solved.x[3 * frames :].reshape(-1, 2).copy()
    points[np.bincount(mark, minlength=drive.count) == 0] = np.nan
    return built - begin, time.process_time() - built, points


def objslam(drive: Drive) -> Solved:
    """Run objslam in joint mode, with known names and its defaults otherwise. It also estimates shared errors and noise."""
    return _objslam(drive, ())


def objslam_plain(drive: Drive) -> Solved:
    """objslam in joint mode without the estimate of shared errors and noise, which the other graphs do not do either."""
    return _objslam(drive, ("calibration.use=false", "noise.rays=false", "noise.ranges=false", "noise.odometry=false"))


def _objslam(drive: Drive, more: tuple[str, ...]) -> Solved:
    begin = time.process_time()
    settings = load_settings(None, ("mode=joint", "association.method=by_label", "output.recording=false", *more))
    result = pipeline.run(drive.log, settings, Ledger())
    names = drive.log.cameras[0].detections.label_names if drive.log.cameras[0].detections else ()
    points = np.full((drive.count, 2), np.nan)
    for o in result.map.objects:
        if o.status == "ok":
            points[names.index(o.label)] = o.position[:2]
    return 0.0, time.process_time() - begin, points


PEERS: dict[str, Callable[[Drive], Solved | str]] = {
    "GTSAM, compiled factors": plain_gtsam,
    "GTSAM, iSAM2": isam2_gtsam,
    "GTSAM, Python factors": custom_gtsam,
    "scipy least_squares": scipy_sparse,
    "objslam, no calibration": objslam_plain,
    "objslam, defaults": objslam,
}
"""The ways to solve a drive, in the order of the table."""
REFERENCE = "GTSAM, iSAM2"
"""The way whose solution replaces an unknown truth."""
