"""Simulate the path of the robot, its odometry and its localisation."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam import config
from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, lift_se2, split_se2
from objslam.core.trajectory import Trajectory
from objslam.simulation.settings import DriveSettings, PoseNoise

START = 1_700_000_000.0  # The stamp of the start of every drive, s.
WHEEL_OFFSET = 0.5
"""The distance from the robot's centre to a wheel in front of it, m. This wheel moves at constant speed. With a larger
value, the robot is slower in bends."""


@dataclass(frozen=True)
class Path:
    """A Lissajous curve that the robot drives repeatedly.

    reach: (2,) the amplitudes along x and y, m. swings: the numbers of swings along x and y in a lap. parameter: (T,)
    samples of the curve parameter over one lap. time: (T,) the time from the start of the lap to each sample, s. offset: the
    time from the start of the lap to the start of the drive, s.
    """

    reach: Floats
    swings: tuple[int, int]
    parameter: Floats
    time: Floats
    offset: float

    @classmethod
    def lay(cls, settings: DriveSettings, rng: np.random.Generator) -> Self:
        """Make the path of a drive. The drive starts at a random position on the curve."""
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
        """The duration of a lap, s."""
        return float(self.time[-1])

    def at(self, stamps: Floats) -> Floats:
        """Return the true x, y (m) and yaw (rad) of base in map, (..., 3), at stamps (...,), s."""
        u = np.interp((stamps - START + self.offset) % self.lap, self.time, self.parameter)
        place, first, _ = _curve(self.reach, self.swings, u)
        return np.concatenate([place, np.arctan2(first[..., 1:], first[..., :1])], axis=-1)


def _curve(reach: Floats, swings: tuple[int, int], u: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the position, and its first and second derivative (..., 2), at parameters u (...,)."""
    rate = np.array(swings, dtype=float)
    both_odd = swings[0] % 2 == 1 and swings[1] % 2 == 1
    angle = rate * u[..., None] + np.array([np.pi / 2 if both_odd else 0.0, 0.0])  # The phase avoids cusps.
    return reach * np.sin(angle), reach * rate * np.cos(angle), -reach * rate**2 * np.sin(angle)


def _integral(values: Floats, over: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(over))])


def frame_stamps(settings: DriveSettings) -> Floats:
    """Return the stamps (F, C), s, of the F images of each of the C cameras. If `settings.together` is False, the cameras
    take turns at even intervals."""
    cameras = len(settings.cameras)
    later = np.zeros(cameras) if settings.together else np.arange(cameras) / cameras
    return START + (np.arange(settings.frames)[:, None] + later) / settings.frame_rate


def odometry(settings: DriveSettings, path: Path, stamps: Floats, rng: np.random.Generator) -> Trajectory | None:
    """Simulate the odometry odom_T_base, as the sum of the true steps with noise. Return None if the drive has no odometry.
    stamps: (F,) the stamps of the images, s."""
    if settings.odometry is None:
        return None
    stamps = _clock(settings.odometry_rate, stamps)
    true = lift_se2(path.at(stamps))
    steps, _ = split_se2(inverse(true[:-1]) @ true[1:])
    sigmas = _step_sigmas(settings.odometry, steps, np.diff(stamps) * settings.frame_rate)
    steps = steps + sigmas * rng.standard_normal(steps.shape)
    start, _ = split_se2(true[0])
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    turns = lift_se2(np.column_stack([np.zeros((len(yaw), 2)), yaw]))[:-1, :2, :2]
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum((turns @ steps[:, :2, None])[..., 0], axis=0)])
    return Trajectory(stamps, lift_se2(np.column_stack([xy, yaw])))


def _step_sigmas(noise: config.Odometry | PoseNoise, steps: Floats, frames: Floats) -> Floats:
    """Return the standard deviations (S, 3) of the noise of steps (S, 3), each as x, y (m) and yaw (rad).

    frames: (S,) the durations of the steps, as multiples of the time between two images.
    """
    if isinstance(noise, PoseNoise):
        return np.sqrt(frames)[:, None] * np.array([noise.xy, noise.xy, noise.yaw])
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    per_m = np.array([noise.x_per_m, noise.y_per_m, noise.yaw_per_m])
    per_rad = np.array([noise.xy_per_rad, noise.xy_per_rad, noise.yaw_per_rad])
    return np.sqrt(way[:, None] * per_m**2 + turn[:, None] * per_rad**2)


def localization(settings: DriveSettings, path: Path, stamps: Floats, rng: np.random.Generator) -> Trajectory | None:
    """Simulate the localisation map_T_base, as true poses with independent errors. Return None if the drive has no
    localisation. stamps: (F,) the stamps of the images, s."""
    noise = settings.localization
    if noise is None:
        return None
    stamps = _clock(settings.localization_rate, stamps)
    error = rng.standard_normal((len(stamps), 3)) * np.array([noise.xy, noise.xy, noise.yaw])
    return Trajectory(stamps, lift_se2(path.at(stamps) + error))


def _clock(rate: float | None, frame_stamps: Floats) -> Floats:
    """Return stamps, s, at `rate` (Hz) that cover all images. If `rate` is None, return the stamps of the images."""
    if rate is None:
        return frame_stamps
    return START + np.arange(int(np.ceil((frame_stamps[-1] - START) * rate)) + 1) / rate
