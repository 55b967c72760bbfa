"""Solve a drive once more, with objects of an older map as priors: its poses, its objects, and its frame in the map.

The graph of the drive stays in its own frame. The pose of this frame in the map is one more variable, F. Each object has two
points. The rays of the drive point to L(j), in the frame of the drive. The other point, P(j) = F * L(j) + e(j), is in the
map. The error e(j) is the sum of the errors that the graph of the drive does not contain, such as the offsets of boxes. If
the map has the object, the map's estimate of the object is the prior of P(j).

The registration gives only the start and the matches, so that the map counts once. The objects of a drifted map share
errors, but the map does not say which errors. So the priors count as independent. With many objects, the frame would then
look too exact. Therefore, the largest error that all objects can share is added to the covariance of the frame.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.estimate import Estimate
from objslam.core.geometry import lift_se2, split_se2
from objslam.core.statistics import HUBER_K
from objslam.core.types import Association
from objslam.graph.assembly import Measurements
from objslam.graph.factors.frames import F0, P0, frame_prior, object_priors, own_errors
from objslam.graph.optimizers import build_graph, indeterminate, levenberg_marquardt
from objslam.graph.variables import L0, make_values, read_poses, with_points

LEAST = 1e-3
"""The least standard deviation (m) of an error of an object. A larger value makes exact maps less exact. This value is far
below the errors of real maps, and keeps the linear system well conditioned."""
_ITERATIONS = 50
"""The largest number of iterations of the solve. A larger number is slower. Usually a handful is enough, because the
registration is a close start."""


@dataclass(frozen=True)
class MapObjects:
    """M objects of an older map that the drive saw. index: (M,) their indices in the drive.

    positions: (M, 3) m and covariance: (M, 3, 3) m^2, in the frame of the map.
    """

    index: Ints
    positions: Floats
    covariance: Floats


@dataclass(frozen=True)
class MappedDrive:
    """A drive with N objects and K keyframes in the frame of an older map.

    map_T_drive: (4, 4) the frame of the drive in the map, turned about z only. covariance: (4, 4) of x, y and z (m) at the
    middle of the matched objects, and of the yaw (rad). map_T_base: (K, 4, 4). seen: (N, 3) m, the objects by the rays
    alone, L(j). positions: (N, 3) m, the objects by rays and map, P(j). object_covariance: (N, 3, 3) m^2 of `positions`.
    Unknown values are NaN.
    """

    map_T_drive: Floats
    covariance: Floats
    map_T_base: Floats
    seen: Floats
    positions: Floats
    object_covariance: Floats


def solve_in_map(
    estimate: Estimate,
    association: Association,
    there: Ints,
    known: MapObjects,
    map_T_drive: Floats,
    measured: Measurements | None,
) -> MappedDrive:
    """Solve a drive in an older map, from the drive's own solution and its registration map_T_drive (4, 4).

    there: (n,) the resolved objects of the drive. The other objects get no covariance in the map. known: the matched
    objects. measured: the measurements of a joint solve, None if the poses of the drive are fixed in its own frame.
    SolveError if the linear system is indeterminate.
    """
    solved = there if measured is None else np.flatnonzero(estimate.solved & np.isfinite(estimate.positions[:, 0]))
    keep = np.isin(known.index, there)
    index, anchor = known.index[keep], known.positions[keep]
    prior = known.covariance[keep] + LEAST**2 * np.eye(3)
    values = make_values(_poses(estimate, measured), estimate.positions, solved)
    drive, plain = (_drive_factors(estimate, association, solved, measured, robust=robust) for robust in (True, False))
    rotation = map_T_drive[:3, :3]
    own = rotation @ _unknown_to(build_graph(plain), values, estimate, there, measured) @ rotation.T
    values.insert(F0, gtsam.Pose3(map_T_drive))
    for j in there.tolist():
        values.insert(P0 + j, map_T_drive[:3, :3] @ estimate.positions[j] + map_T_drive[:3, 3])
    frames = [frame_prior(map_T_drive), *own_errors(there, own)]
    priors = object_priors(P0, index, anchor, prior, robust=True)
    found = levenberg_marquardt(build_graph(drive, frames, priors), values, _ITERATIONS).values
    placed = np.array([found.atPoint3(P0 + j) for j in there.tolist()]).reshape(-1, 3)
    miss = anchor - placed[np.searchsorted(there, index)]
    deviation = np.sqrt(np.einsum("mi,mi->m", miss, np.linalg.solve(prior, miss[..., None])[..., 0]))
    weighted = prior * np.maximum(deviation / HUBER_K, 1.0)[:, None, None]
    last = object_priors(P0, index, anchor, weighted, robust=False)
    graph = build_graph(plain, frames, last)
    frame = lift_se2(split_se2(found.atPose3(F0).matrix())[0])
    frame[2, 3] = found.atPose3(F0).matrix()[2, 3]
    pivot = anchor.mean(axis=0)
    covariance, spread = _covariances(graph, found, there, frame, pivot)
    doubt = shared_at_most(anchor, prior, pivot)
    positions, seen, spreads = (
        np.full(a.shape, np.nan) for a in (estimate.positions, estimate.positions, estimate.covariance)
    )
    fixed = np.isfinite(estimate.positions[:, 0])
    seen[fixed] = estimate.positions[fixed] @ frame[:3, :3].T + frame[:3, 3]
    if measured is not None:
        seen[solved] = with_points(estimate.positions, solved, found)[solved] @ frame[:3, :3].T + frame[:3, 3]
    positions[fixed] = seen[fixed]
    positions[there], spreads[there] = placed, _with_doubt(spread, placed, there, index, weighted, doubt, pivot)
    drive_T_base = estimate.map_T_base if measured is None else measured.map_T_base(read_poses(found))
    return MappedDrive(frame, covariance + doubt, frame @ drive_T_base, seen, positions, spreads)


def _poses(estimate: Estimate, measured: Measurements | None) -> Floats:
    if measured is None:
        return np.zeros((0, 4, 4))
    first = measured.multiframes.first
    return estimate.map_T_base[first] @ measured.images.base_T_camera[first]


def _drive_factors(
    estimate: Estimate, association: Association, solved: Ints, measured: Measurements | None, *, robust: bool
) -> list[gtsam.NonlinearFactor]:
    """Return the factors of the drive alone. At fixed poses, they are priors with half the covariance of each object.

    robust: whether the rays have the loss of the settings. `gnc` gives no loss, because only its own optimiser applies it.
    """
    if measured is None:
        return object_priors(L0, solved, estimate.positions[solved], estimate.covariance[solved] / 2, robust=False)
    used = (estimate.weight > 0) & np.isin(association.object, solved)
    loss = measured.settings.joint.loss if robust and measured.settings.joint.loss != "gnc" else "gnc"
    factors = measured.factors(association.object, np.flatnonzero(used), solved, estimate.positions, loss)
    return factors + measured.localized_factors


def _unknown_to(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, estimate: Estimate, there: Ints, measured: Measurements | None
) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of the errors of the objects `there` that the graph does not contain."""
    floor = LEAST**2 * np.eye(3)
    if measured is None:  # `_drive_factors` has the other half. Equal halves condition the linear system best.
        return estimate.covariance[there] / 2 + floor
    try:
        marginals = gtsam.Marginals(graph, values)
        alone = np.array([marginals.marginalCovariance(L0 + j) for j in there.tolist()]).reshape(-1, 3, 3)
    except RuntimeError as error:
        raise indeterminate(error) from error
    return beyond(estimate.covariance[there], alone)


def beyond(covariance: Floats, alone: Floats) -> Floats:
    """Return the excess (n, 3, 3), m^2, of covariances over `alone` (n, 3, 3). It is at least `LEAST`^2 along each axis."""
    size, axes = np.linalg.eigh(covariance - alone)
    return np.asarray((axes * np.maximum(size, LEAST**2)[:, None, :]) @ np.swapaxes(axes, 1, 2))


def _covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, there: Ints, frame: Floats, pivot: Floats
) -> tuple[Floats, Floats]:
    """Return the covariance (4, 4) of a frame (4, 4) at a pivot (3,) m, and covariances (n, 3, 3) m^2 of the points P."""
    try:
        marginals = gtsam.Marginals(graph, values)
        spread = np.array([marginals.marginalCovariance(P0 + j) for j in there.tolist()]).reshape(-1, 3, 3)
        tangent = marginals.marginalCovariance(F0)
    except RuntimeError as error:
        raise indeterminate(error) from error
    to_pivot = np.zeros((4, 6))  # The Jacobian of shift and yaw by the tangent of F (rotation first).
    to_pivot[:3, 3:], to_pivot[3, 2] = values.atPose3(F0).rotation().matrix(), 1.0
    to_pivot[:3, 2] = _turned(pivot - frame[:3, 3])
    return to_pivot @ tangent @ to_pivot.T, spread


def shared_at_most(positions: Floats, covariance: Floats, pivot: Floats) -> Floats:
    """Return the covariance (4, 4) of the largest error that all objects of a map can share: a shift (m) and a yaw (rad).

    The error of each object contains the shared error. So the covariance of the shift is the smallest covariance of an
    object. The yaw turns about the pivot (3,) m, and moves no object by more than the object's standard deviation.
    positions: (M, 3) m. covariance: (M, 3, 3) m^2.
    """
    level = np.trace(covariance[:, :2, :2], axis1=1, axis2=2) / 2
    lever = ((positions - pivot)[:, :2] ** 2).sum(axis=1)
    shared = np.zeros((4, 4))
    shared[:3, :3] = covariance[np.trace(covariance, axis1=1, axis2=2).argmin()]
    shared[3, 3] = (level / np.maximum(lever, 1e-9)).min()
    return shared


def _with_doubt(
    spread: Floats, placed: Floats, there: Ints, index: Ints, prior: Floats, doubt: Floats, pivot: Floats
) -> Floats:
    """Add the error that all map objects share to the covariances `spread` (n, 3, 3), m^2, of points `placed` (n, 3), m.

    doubt: (4, 4) the covariance of this error, from `shared_at_most`. there: (n,) the objects. index: (M,) the objects with
    a prior. prior: (M, 3, 3) m^2. The more a prior determines a point, the less the shared error moves the point.
    """
    move = np.zeros((len(there), 3, 4))
    move[:, :, :3] = np.eye(3)
    move[:, :, 3] = np.array([_turned(p - pivot) for p in placed]).reshape(-1, 3)
    row = np.searchsorted(there, index)
    move[row] = (np.eye(3) - spread[row] @ np.linalg.inv(prior)) @ move[row]
    covariance = spread + move @ doubt @ np.swapaxes(move, 1, 2)
    return np.asarray((covariance + np.swapaxes(covariance, 1, 2)) / 2)


def _turned(lever: Floats) -> Floats:
    """Return the derivative (3,), m per rad, of a point by a yaw about a pivot. lever: (3,) m from pivot to point."""
    return np.array([-lever[1], lever[0], 0.0])
