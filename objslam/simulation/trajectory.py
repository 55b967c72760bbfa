"""How the robot moves, and what its odometry and localisation say about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam import config
from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, lift_se2, split_se2
from objslam.core.types import Trajectory
from objslam.simulation.settings import DriveSettings, PoseNoise

START = 1_700_000_000.0
"""s; the stamp at which every drive starts."""

WHEEL_OFFSET = 0.5
"""m; a wheel so far off the middle keeps its speed, so bends are driven more slowly the tighter they are."""


@dataclass(frozen=True)
class Path:
    """A Lissajous curve, driven over and over again.

    reach: (2,) m. parameter: (T,) of the curve over one lap. time: (T,) s since the start of the lap. offset: s, where in
    the lap the drive starts.
    """

    reach: Floats
    swings: tuple[int, int]
    parameter: Floats
    time: Floats
    offset: float

    @classmethod
    def lay(cls, settings: DriveSettings, rng: np.random.Generator) -> Self:
        """The path of a drive; where on it the drive starts is random."""
        reach = np.array(settings.room) / 2 - settings.margin
        u = np.linspace(0.0, 2 * np.pi, 20_001)
        _, first, second = _curve(reach, settings.path, u)
        speed = np.hypot(first[..., 0], first[..., 1])
        bend = np.abs(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]) / speed**3
        length = _integral(speed, u)[-1]
        time = _integral(speed * np.hypot(1.0, WHEEL_OFFSET * bend), u)
        lap = settings.frames / settings.frame_rate / settings.laps if settings.laps else length / settings.speed
        return cls(reach, settings.path, u, time * (lap / time[-1]), float(rng.uniform(0.0, lap)))

    @property
    def lap(self) -> float:
        """s; how long one lap takes."""
        return float(self.time[-1])

    def at(self, stamps: Floats) -> Floats:
        """The true x, y (m) and yaw (rad) of base in map, (..., 3), at stamps (...,)."""
        u = np.interp((stamps - START + self.offset) % self.lap, self.time, self.parameter)
        place, first, _ = _curve(self.reach, self.swings, u)
        return np.concatenate([place, np.arctan2(first[..., 1:], first[..., :1])], axis=-1)


def _curve(reach: Floats, swings: tuple[int, int], u: Floats) -> tuple[Floats, Floats, Floats]:
    """Place, first and second derivative (..., 2) at parameters u (...,)."""
    rate = np.array(swings, dtype=float)
    both_odd = swings[0] % 2 == 1 and swings[1] % 2 == 1
    angle = rate * u[..., None] + np.array([np.pi / 2 if both_odd else 0.0, 0.0])  # with this phase there are no cusps
    return reach * np.sin(angle), reach * rate * np.cos(angle), -reach * rate**2 * np.sin(angle)


def _integral(values: Floats, over: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(over))])


def odometry(settings: DriveSettings, path: Path, frame_stamps: Floats, rng: np.random.Generator) -> Trajectory | None:
    """odom_T_base as the wheels tell it: the true steps with their noise, summed up from the true first pose."""
    if settings.odometry is None:
        return None
    stamps = _clock(settings.odometry_rate, frame_stamps)
    true = lift_se2(path.at(stamps))
    steps, _ = split_se2(inverse(true[:-1]) @ true[1:])
    steps = steps + _step_sigmas(settings.odometry, steps, np.diff(stamps) * settings.frame_rate) * rng.standard_normal(
        steps.shape
    )
    start, _ = split_se2(true[0])
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moves = (lift_se2(np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=-1))[:-1, :2, :2] @ steps[:, :2, None])[
        ..., 0
    ]
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return Trajectory(stamps, lift_se2(np.column_stack([xy, yaw])))


def _step_sigmas(noise: config.Odometry | PoseNoise, steps: Floats, frames: Floats) -> Floats:
    """Standard deviations (S, 3) of steps (S, 3), each lasting as many frames as `frames` (S,) says."""
    if isinstance(noise, PoseNoise):
        return np.sqrt(frames)[:, None] * np.array([noise.xy, noise.xy, noise.yaw])
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    per_m = np.array([noise.x_per_m, noise.y_per_m, noise.yaw_per_m])
    per_rad = np.array([noise.xy_per_rad, noise.xy_per_rad, noise.yaw_per_rad])
    return np.sqrt(way[:, None] * per_m**2 + turn[:, None] * per_rad**2)


def localization(settings: DriveSettings, path: Path, frame_stamps: Floats, rng: np.random.Generator) -> Trajectory | None:
    """map_T_base as a lidar's localisation tells it: the true poses, each with an error of its own."""
    if settings.localization is None:
        return None
    stamps = _clock(settings.localization_rate, frame_stamps)
    noise = settings.localization
    error = rng.standard_normal((len(stamps), 3)) * np.array([noise.xy, noise.xy, noise.yaw])
    return Trajectory(stamps, lift_se2(path.at(stamps) + error))


def _clock(rate: float | None, frame_stamps: Floats) -> Floats:
    """Stamps at `rate` from the first frame until the last is covered; without a rate, those of the frames."""
    if rate is None:
        return frame_stamps
    return START + np.arange(int(np.ceil((frame_stamps[-1] - START) * rate)) + 1) / rate
