"""The drift of odometry, which is the covariance that it accumulates along its path."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np

from objslam.config import Odometry, Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, twist_length, twist_lengths
from objslam.core.types import Trajectory

Length = TypeVar("Length", float, Floats)


def scaled_noise(settings: Settings, error: Mapping[str, float]) -> Settings:
    """Return the settings with the odometry noise for distances that are longer by the share "odometry.scale" in `error`.

    The noise of positions grows like the distances. Otherwise a map of another size would fit better or worse.
    """
    way = 1 + error.get("odometry.scale", 0.0)
    if way == 1:
        return settings
    of = settings.odometry
    scaled = {name: getattr(of, name) * np.sqrt(way) for name in ("x_per_m", "y_per_m")}
    scaled |= {name: getattr(of, name) * way for name in ("xy_per_rad", "floor_xy")}
    scaled["yaw_per_m"] = of.yaw_per_m / np.sqrt(way)
    return settings.model_copy(update={"odometry": of.model_copy(update=scaled)})


def gathered_drift(odometry: Trajectory, stamps: Floats, settings: Odometry) -> Floats:
    """Return the covariance (Q, 6, 6) that the odometry has accumulated up to each of the stamps (Q,), s, rotation first.

    The covariance is in the frame of the first pose. The adjoint moves the noise of each step into this frame, where the
    steps are summed. For two stamps i < j, drift[j] - drift[i] is the covariance of the motion from i to j. The adjoint can
    move it into base at j.
    """
    return DriftPath(odometry).gathered(stamps, settings)


class DriftPath:
    """The steps of an odometry, from which its drift is computed quickly, for any noise and stamps.

    On a planar path, ten times fewer numbers are computed.
    """

    def __init__(self, odometry: Trajectory) -> None:
        """Measure the steps of the odometry. Where poses were left out, a step is as long as what was travelled in it."""
        self._odometry = odometry
        poses = odometry.poses
        start, places = poses[0, :3, :3], (poses[:, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, :3]
        up = start[:, 2] @ poses[:, :3, :3]
        self._planar = bool(max(np.abs(up - up[0]).max(), np.abs(places[:, 2]).max()) <= _PLANAR_TOLERANCE)
        if not self._planar:
            return
        heading = poses[:, :3, 0] @ start[:, :2]
        c, s = (heading[1:] / np.maximum(np.linalg.norm(heading[1:], axis=1, keepdims=True), 1e-12)).T
        yaw = np.arctan2(heading[:, 1], heading[:, 0])
        if odometry.travel is None:
            self._turn = np.abs((np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi)
            self._way = np.hypot(*np.diff(places[:, :2], axis=0).T) / np.sinc(self._turn / (2 * np.pi))
        else:
            self._way, self._turn = odometry.travel[1:, 0], odometry.travel[1:, 1]
        px, py = places[1:, 0], places[1:, 1]
        one, none = np.ones_like(px), np.zeros_like(px)
        # How each variance of a step (of yaw, x, y) adds to the six distinct elements of the covariance, see `_PLANAR`.
        self._parts = (
            np.stack([one, py, -px, py * py, -px * py, px * px], axis=1),
            np.stack([none, none, none, c * c, c * s, s * s], axis=1),
            np.stack([none, none, none, s * s, -c * s, c * c], axis=1),
        )

    def gathered(self, stamps: Floats, settings: Odometry) -> Floats:
        """Return the drift (Q, 6, 6) at stamps (Q,), as `gathered_drift` does."""
        odometry = self._odometry
        if len(odometry) == 1:
            return np.zeros((len(stamps), 6, 6))
        if self._planar:
            variances = _step_variances(self._turn, self._way, settings)
            angle, x, y = (variance[:, None] * part for variance, part in zip(variances, self._parts, strict=True))
            steps = angle + x + y
        else:
            start_T_base, travel = inverse(odometry.poses[0]) @ odometry.poses, odometry.travel
            lengths = None if travel is None else (travel[1:, 1], travel[1:, 0])
            steps = step_drift(start_T_base, settings, False, lengths).reshape(-1, 36)
        total = np.zeros((len(odometry), steps.shape[1]))
        np.cumsum(steps, axis=0, out=total[1:])
        after = np.clip(np.searchsorted(odometry.stamps, stamps), 1, len(odometry) - 1)
        span = odometry.stamps[after] - odometry.stamps[after - 1]
        share = np.clip((stamps - odometry.stamps[after - 1]) / span, 0.0, 1.0)[:, None]
        gathered = (1 - share) * total[after - 1] + share * total[after]
        if not self._planar:
            return np.asarray(gathered.reshape(-1, 6, 6))
        drift = np.zeros((len(stamps), 6, 6))
        drift[:, 2:5, 2:5] = gathered[:, _PLANAR]
        return drift


_PLANAR = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""The index of each element of a symmetric matrix (yaw, x, y) among its six distinct elements."""
_PLANAR_TOLERANCE = 1e-6
"""The largest change (m, rad) of height, roll or pitch on a planar path, as in `geometry.is_planar`."""


def step_drift(
    start_T_base: Floats, settings: Odometry, planar: bool, lengths: tuple[Floats, Floats] | None = None
) -> Floats:
    """Return the covariance (N-1, 6, 6), rotation first, of the noise of each step between poses (N, 4, 4).

    The covariance is in the frame `start`. The noise of a step grows with its length and with its angle. If `planar`, it
    affects x, y and yaw of the base. If not, it affects all six directions. lengths: (N-1,) rad and (N-1,) m, of each step.
    By default, they are computed from the poses.
    """
    turn, way = lengths or twist_lengths(inverse(start_T_base[:-1]) @ start_T_base[1:])
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
