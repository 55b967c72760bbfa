"""The drift of odometry, which is the covariance that it accumulates along its path."""

from typing import TypeVar

import numpy as np

from objslam.config import Odometry
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, is_planar, twist_length, twist_lengths
from objslam.core.types import Trajectory

Length = TypeVar("Length", float, Floats)


def gathered_drift(odometry: Trajectory, stamps: Floats, settings: Odometry) -> Floats:
    """Return the covariance (Q, 6, 6) that the odometry has accumulated up to each of the stamps (Q,), rotation first.

    The covariance is in the frame of the first pose. The adjoint moves the noise of each step into this frame, where the
    steps are summed. For two stamps i < j, drift[j] - drift[i] is the covariance of the motion from i to j. Moved into base
    at j, this covariance shows how an error of the heading shifts the later positions.
    """
    if len(odometry) == 1:
        return np.zeros((len(stamps), 6, 6))
    start_T_base = inverse(odometry.poses[0]) @ odometry.poses
    steps = step_drift(start_T_base, settings, planar=is_planar(start_T_base))
    total = np.zeros((len(odometry), 36))
    np.cumsum(steps.reshape(-1, 36), axis=0, out=total[1:])
    after = np.clip(np.searchsorted(odometry.stamps, stamps), 1, len(odometry) - 1)
    span = odometry.stamps[after] - odometry.stamps[after - 1]
    share = np.clip((stamps - odometry.stamps[after - 1]) / span, 0.0, 1.0)[:, None]
    return ((1 - share) * total[after - 1] + share * total[after]).reshape(-1, 6, 6)


def step_drift(start_T_base: Floats, settings: Odometry, planar: bool) -> Floats:
    """Return the covariance (N-1, 6, 6), rotation first, of the noise of each step between poses (N, 4, 4).

    It is in the frame `start`. The noise of a step grows with its length and with its angle. On a planar path it affects x,
    y and yaw of the base. On other paths it affects all six directions.
    """
    turn, way = twist_lengths(inverse(start_T_base[:-1]) @ start_T_base[1:])
    angle, x, y = _step_variances(turn, way, settings)
    none = np.zeros_like(way)
    noise = np.stack([none, none, angle, x, y, none] if planar else [angle, angle, angle, x, x, x], axis=1)
    moved = adjoint(start_T_base[1:])
    return np.asarray(np.einsum("nij,nj,nkj->nik", moved, noise, moved))


def add_step(drift: Floats, before: Floats, after: Floats, settings: Odometry, planar: bool) -> Floats:
    """Return a covariance (6, 6) to which the noise of the step between two poses (4, 4) is added, as by `step_drift`.

    A session calls this function for every pose. It avoids numpy, and takes a tenth of the time of `step_drift`.
    """
    angle, x, y = _step_variances(*twist_length(before, after), settings)
    total = drift.copy()
    if not planar:
        moved = adjoint(after)
        total += (moved * [angle, angle, angle, x, x, x]) @ moved.T
        return total
    (c, _, _, px), (s, _, _, py) = after[:2].tolist()
    yaw_x, yaw_y, xy = angle * py, -angle * px, -angle * px * py + (x - y) * c * s
    total[2:5, 2:5] += [
        [angle, yaw_x, yaw_y],
        [yaw_x, angle * py * py + x * c * c + y * s * s, xy],
        [yaw_y, xy, angle * px * px + x * s * s + y * c * c],
    ]
    return total


def _step_variances(turn: Length, way: Length, settings: Odometry) -> tuple[Length, Length, Length]:
    """Return the variances of yaw (rad^2), x (m^2) and y (m^2) after a turn (rad) over a way (m)."""
    angle = settings.yaw_per_m**2 * way + settings.yaw_per_rad**2 * turn
    x = settings.x_per_m**2 * way + settings.xy_per_rad**2 * turn
    y = settings.y_per_m**2 * way + settings.xy_per_rad**2 * turn
    return angle, x, y
