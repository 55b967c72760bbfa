"""Measure by how much the shared errors are less certain because noise is correlated in time.

The gradient by a parameter is a sum over measurements. It is split into sums over windows of time, and its variance is the
variance of these sums. Noise need not be white inside a window (cluster-robust covariance; Liang and Zeger 1986).
"""

import numpy as np

from objslam.core.arrays import Floats
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.shared_error_jacobian import LinearSystem
from objslam.graph.calibration.variance_components import correlation_time


def correlation_factors(of: Linearised, system: LinearSystem) -> Floats:
    """Return the factors (P,) >= 1 on the standard deviations of the gradients by the shared errors.

    A factor is the standard deviation from sums over windows of `correlation_time` seconds, divided by the standard
    deviation for white noise. system: the linear system of the graph `of`.
    """
    jacobian = system.jacobian
    told = np.column_stack([system.residual, system.instruments, system.sides])
    left = told - jacobian @ system.normal.solve(jacobian.T @ told)
    count = system.sides.shape[1]
    parts, reduced = left[:, 1 : 1 + count] * left[:, :1], left[:, 1 + count :]
    window = np.floor(_seconds(of, system) / correlation_time(of.measured.keyframes.stamps)).astype(np.int64)
    sums = np.zeros((int(window.max(initial=0)) + 1, count))
    np.add.at(sums, window, parts)
    white = np.maximum((reduced**2).sum(axis=0), 1e-300)
    return np.asarray(np.sqrt(np.maximum((sums**2).sum(axis=0) / white, 1.0)))


def _seconds(of: Linearised, system: LinearSystem) -> Floats:
    """Return the time (M,) of each row after the first keyframe, s. It is 0 for landmark priors, absolute poses and tags."""
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
