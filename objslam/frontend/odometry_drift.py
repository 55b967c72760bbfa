"""The covariance that odometry accumulates on its way."""

from __future__ import annotations

import numpy as np

from objslam.config import Odometry
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, is_planar, twist_length, twist_lengths
from objslam.core.types import Trajectory


def gathered_drift(odometry: Trajectory, stamps: Floats, settings: Odometry) -> Floats:
    """Covariance (Q, 6, 6) that the odometry has accumulated at each of the stamps (Q,), in the frame of its first pose.

    Each step brings noise of its own in base, which grows with the way and with the angle: x, y and yaw on a planar path,
    else all six. The adjoint moves it to the common frame, where steps add up. Between two stamps i < j, moved back to base
    at j, drift[j] - drift[i] is then the covariance of the motion, with the lever arms of the heading.
    """
    start_T_base = inverse(odometry.poses[0]) @ odometry.poses
    steps = step_drift(start_T_base, settings, planar=is_planar(start_T_base))
    total = np.zeros((len(odometry), 36))
    np.cumsum(steps.reshape(-1, 36), axis=0, out=total[1:])
    if len(odometry) == 1:
        return np.zeros((len(stamps), 6, 6))
    after = np.clip(np.searchsorted(odometry.stamps, stamps), 1, len(odometry) - 1)
    span = odometry.stamps[after] - odometry.stamps[after - 1]
    share = np.clip((stamps - odometry.stamps[after - 1]) / span, 0.0, 1.0)[:, None]
    return ((1 - share) * total[after - 1] + share * total[after]).reshape(-1, 6, 6)


def step_drift(start_T_base: Floats, settings: Odometry, planar: bool) -> Floats:
    """Covariances (N-1, 6, 6) that the steps between poses (N, 4, 4) add, in the frame that the poses are given in."""
    turn, way = twist_lengths(inverse(start_T_base[:-1]) @ start_T_base[1:])
    angle = settings.yaw_per_m**2 * way + settings.yaw_per_rad**2 * turn
    x = settings.x_per_m**2 * way + settings.xy_per_rad**2 * turn
    y = settings.y_per_m**2 * way + settings.xy_per_rad**2 * turn
    none = np.zeros_like(way)
    noise = np.stack([none, none, angle, x, y, none] if planar else [angle, angle, angle, x, x, x], axis=1)
    moved = adjoint(start_T_base[1:])
    return np.asarray(np.einsum("nij,nj,nkj->nik", moved, noise, moved))


def add_step(drift: Floats, before: Floats, after: Floats, settings: Odometry, planar: bool) -> Floats:
    """The covariance drift (6, 6) and what `step_drift` adds to it for the step between two poses (4, 4).

    It takes a tenth of the time, because it hardly needs numpy: a session calls it for every pose.
    """
    turn, way = twist_length(before, after)
    angle = settings.yaw_per_m**2 * way + settings.yaw_per_rad**2 * turn
    x = settings.x_per_m**2 * way + settings.xy_per_rad**2 * turn
    total = drift.copy()
    if not planar:
        moved = adjoint(after)
        total += (moved * [angle, angle, angle, x, x, x]) @ moved.T
        return total
    y = settings.y_per_m**2 * way + settings.xy_per_rad**2 * turn
    (c, _, _, px), (s, _, _, py) = after[:2].tolist()
    yaw_x, yaw_y, xy = angle * py, -angle * px, -angle * px * py + (x - y) * c * s
    total[2:5, 2:5] += [
        [angle, yaw_x, yaw_y],
        [yaw_x, angle * py * py + x * c * c + y * s * s, xy],
        [yaw_y, xy, angle * px * px + x * s * s + y * c * c],
    ]
    return total
