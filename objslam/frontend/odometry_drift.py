"""The drift of odometry, which is the covariance that it accumulates along its path."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np

from objslam.config import Odometry, Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, twist_length, twist_lengths
from objslam.core.trajectory import Trajectory

Length = TypeVar("Length", float, Floats)


def scaled_noise(settings: Settings, error: Mapping[str, float]) -> Settings:
    """Return the settings with the odometry noise for distances that are corrected by the error "odometry.scale".

    The noise of positions is multiplied like the distances. Otherwise the size of the map would change how well it fits.
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
    return DriftPath.of(odometry).gathered(stamps, settings)


@dataclass(frozen=True)
class DriftPath:
    """The steps of an odometry with N poses, from which its drift is computed quickly, for any noise and stamps.

    odometry: None if `sums` replace it. stamps: (N,) s. sums: (14, N) what a planar path has gathered up to each pose, from
    `PlanarSteps.sums`. None if the path is not planar.
    """

    odometry: Trajectory | None
    stamps: Floats
    sums: Floats | None

    @classmethod
    def of(cls, odometry: Trajectory) -> Self:
        """Measure the steps of the odometry. If measured poses were left out of a step, its length is that of the whole way
        through them."""
        poses = odometry.poses
        start, places = poses[0, :3, :3], (poses[:, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, :3]
        up = start[:, 2] @ poses[:, :3, :3]
        if max(np.abs(up - up[0]).max(), np.abs(places[:, 2]).max()) > _PLANAR_TOLERANCE:
            return cls(odometry, odometry.stamps, None)
        heading = poses[:, :3, 0] @ start[:, :2]
        heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-12)
        cos, sin = heading.T
        if odometry.travel is None:
            steps = PlanarSteps.between(cos, sin, places[:, 0], places[:, 1])
        else:
            steps = PlanarSteps(cos, sin, places[:, 0], places[:, 1], odometry.travel[1:, 0], odometry.travel[1:, 1])
        return cls(None, odometry.stamps, steps.sums())

    def gathered(self, stamps: Floats, settings: Odometry) -> Floats:
        """Return the drift (Q, 6, 6) at stamps (Q,), as `gathered_drift` does."""
        last = len(self.stamps) - 1
        if last == 0:
            return np.zeros((len(stamps), 6, 6))
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, last)
        span = self.stamps[after] - self.stamps[after - 1]
        share = np.clip((stamps - self.stamps[after - 1]) / span, 0.0, 1.0)
        if self.sums is not None:
            drift = np.zeros((len(stamps), 6, 6))
            sums = (1 - share) * self.sums[:, after - 1] + share * self.sums[:, after]
            drift[:, 2:5, 2:5] = (_weights(settings) @ sums).T[:, _PLANAR]
            return drift
        assert self.odometry is not None
        start_T_base, travel = inverse(self.odometry.poses[0]) @ self.odometry.poses, self.odometry.travel
        lengths = None if travel is None else (travel[1:, 1], travel[1:, 0])
        steps = step_drift(start_T_base, settings, False, lengths).reshape(-1, 36)
        total = np.zeros((last + 1, 36))
        np.cumsum(steps, axis=0, out=total[1:])
        gathered = (1 - share)[:, None] * total[after - 1] + share[:, None] * total[after]
        return np.asarray(gathered.reshape(-1, 6, 6))


@dataclass(frozen=True)
class PlanarSteps:
    """The steps of a planar path with N poses, in the frame of its first pose.

    cos, sin: (N,) of the headings. x, y: (N,) m. way: (N-1,) m and turn: (N-1,) rad, the lengths of the steps.
    """

    cos: Floats
    sin: Floats
    x: Floats
    y: Floats
    way: Floats
    turn: Floats

    @classmethod
    def between(cls, cos: Floats, sin: Floats, x: Floats, y: Floats) -> Self:
        """Measure the steps between poses. Each step is taken to be an arc."""
        turn = np.abs(np.arctan2(sin[1:] * cos[:-1] - cos[1:] * sin[:-1], cos[1:] * cos[:-1] + sin[1:] * sin[:-1]))
        way = np.hypot(np.diff(x), np.diff(y)) / np.sinc(turn / (2 * np.pi))
        return cls(cos, sin, x, y, way, turn)

    def sums(self) -> Floats:
        """Return the sums (14, N) up to each pose. `_weights` makes the six elements of the drift from them.

        The variances of a step are linear in its way and its turn, so the same sums are valid for any noise.
        """
        cos, sin, x, y = self.cos[1:], self.sin[1:], self.x[1:], self.y[1:]
        sums = np.zeros((14, len(self.x)))
        for first, length in ((0, self.way), (6, self.turn)):
            by_x, by_y = length * x, length * y
            for row, part in enumerate((length, by_y, by_x, by_y * y, by_y * x, by_x * x)):
                np.cumsum(part, out=sums[first + row, 1:])
        along = self.way * cos
        np.cumsum(along * cos, out=sums[12, 1:])
        np.cumsum(along * sin, out=sums[13, 1:])
        return sums


def _weights(settings: Odometry) -> Floats:
    """Return the weights (6, 14) of the sums of `PlanarSteps` in the six distinct elements of the drift (`_PLANAR`)."""
    by_way, by_turn = (_step_variances(turn, way, settings) for turn, way in ((0.0, 1.0), (1.0, 0.0)))
    weights = np.zeros((6, 14))
    for first, (angle, _, _) in ((0, by_way), (6, by_turn)):
        weights[np.arange(6), first + np.arange(6)] = angle * np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
    (_, x, y), (_, turned, _) = by_way, by_turn  # A turn adds the same variance to x and y.
    weights[3, [0, 6, 12]] += y, turned, x - y
    weights[5, [0, 6, 12]] += x, turned, y - x
    weights[4, 13] = x - y
    return weights


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
