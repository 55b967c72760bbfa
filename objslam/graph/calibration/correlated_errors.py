"""Measure by how much the shared errors are less certain because noise is correlated.

The gradient by a parameter is a sum over measurements. It is split into sums over clusters, and its variance is estimated
from the squares of the sums. Noise need not be white inside a cluster (cluster-robust covariance; Liang and Zeger 1986).
Errors of poses are correlated for some seconds. Errors of boxes are correlated as long as the robot sees the same thing,
because a detector draws the box of a thing too far to one side from all places nearby.
"""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.shared_error_jacobian import LinearSystem
from objslam.graph.calibration.variance_components import correlation_time


def correlation_factors(of: Linearised, system: LinearSystem) -> Floats:
    """Return the factors (P,) >= 1 on the standard deviations of the gradients by the shared errors.

    A factor is the standard deviation from sums over clusters, divided by the standard deviation for white noise. Two kinds
    of clusters are tried, and the larger factor counts. One kind is windows of `correlation_time` seconds. The other kind is
    all boxes of an object, with windows for all other measurements. system: the linear system of the graph `of`.
    """
    jacobian = system.jacobian
    told = np.column_stack([system.residual, system.instruments, system.sides])
    left = told - jacobian @ system.normal.solve(jacobian.T @ told)
    count = system.sides.shape[1]
    parts, reduced = left[:, 1 : 1 + count] * left[:, :1], left[:, 1 + count :]
    window = np.floor(_seconds(of, system) / correlation_time(of.measured.keyframes.stamps)).astype(np.int64)
    white = np.maximum((reduced**2).sum(axis=0), 1e-300)
    largest = np.ones(count)
    for cluster in (window, _by_object(of, system, window)):
        sums = np.zeros((int(cluster.max(initial=0)) + 1, count))
        np.add.at(sums, cluster, parts)
        largest = np.maximum(largest, (sums**2).sum(axis=0) / white)
    return np.asarray(np.sqrt(largest))


def _by_object(of: Linearised, system: LinearSystem, window: Ints) -> Ints:
    """Return the cluster (M,) of each row: one for all bearings and ranges of an object, the `window` (M,) for other
    rows."""
    rays, owner = of.measured.rays.take(of.which), of.association.object[of.which]
    if of.measured.tags is not None:  # The corners of a fiducial err together.
        owner = of.measured.tags.object_of_landmark()[owner]
    cluster = window + int(owner.max(initial=-1)) + 1
    cluster[: 2 * len(owner)] = np.repeat(owner, 2)
    ranged = owner[np.isfinite(rays.range)]
    cluster[system.first_range : system.first_range + len(ranged)] = ranged
    return cluster


def _seconds(of: Linearised, system: LinearSystem) -> Floats:
    """Return the time (M,), s, of each row since the first keyframe. It is 0 for landmark priors, absolute poses and
    tags."""
    keyframes, rays = of.measured.keyframes, of.measured.rays.take(of.which)
    stamps = np.maximum.accumulate(keyframes.stamps) - keyframes.stamps[0]
    seen, ranged = stamps[rays.keyframe], np.isfinite(rays.range)
    seconds = np.zeros(len(system.residual))
    seconds[: 2 * len(seen)] = np.repeat(seen, 2)
    seconds[system.first_range : system.first_range + int(ranged.sum())] = seen[ranged]
    if of.measured.motions is not None:
        moved = np.repeat(stamps[of.measured.motions.after], 6)
        seconds[system.first_motion : system.first_motion + len(moved)] = moved
    return seconds
