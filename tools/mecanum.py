"""Robots that drive in all directions, as with mecanum wheels: their motion and their odometry, for `bench_robots.py`."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory

SLIDES = 0.1
"""The spread over robots of the share by which wheels with rollers seem to go farther sideways than they do."""


def drive(
    rng: np.random.Generator, room: Floats, speed: float, seconds: float, step: float
) -> tuple[Floats, Floats, Floats]:
    """Drive to random points of a room (2,), m, and turn meanwhile to look somewhere else.

    Returns stamps (n,), the path (n, 3) x, y, yaw, and the speeds (n, 3) ahead, to the left and in turning.
    """
    count = int(seconds / step)
    path, speeds = np.zeros((count, 3)), np.zeros((count, 3))
    at, moving, yaw, turning, wait = np.zeros(2), np.zeros(2), rng.uniform(-np.pi, np.pi), 0.0, 1.0
    goal, facing = rng.uniform(-0.5, 0.5, 2) * room, rng.uniform(-np.pi, np.pi)
    for i in range(count):
        c, s = np.cos(yaw), np.sin(yaw)
        path[i], speeds[i] = (*at, yaw), (c * moving[0] + s * moving[1], c * moving[1] - s * moving[0], turning)
        to = goal - at
        far = float(np.hypot(*to))
        if far < 0.3:
            goal, facing = rng.uniform(-0.5, 0.5, 2) * room, yaw + rng.uniform(-2, 2)
            if rng.random() < 0.4:
                wait = rng.uniform(0, 4)
        off = (facing - yaw + np.pi) % (2 * np.pi) - np.pi
        wanted, wanted_turning = speed * to / max(far, 0.5), np.clip(1.5 * off, -0.8, 0.8)
        if wait > 0:
            wait, wanted, wanted_turning = wait - step, np.zeros(2), 0.0
        moving = moving + np.clip(wanted - moving, -0.8 * step, 0.8 * step)
        turning += np.clip(wanted_turning - turning, -2 * step, 2 * step)
        at, yaw = at + moving * step, yaw + turning * step
    return np.arange(count) * step, path, speeds


def odometry(rng: np.random.Generator, stamps: Floats, speeds: Floats, rate: float) -> tuple[Trajectory, dict[str, float]]:
    """The odometry of four wheels with rollers, which slip sideways, and its errors. rate: poses in a second."""
    step = float(stamps[1] - stamps[0])
    moves, slip = speeds * step, rng.uniform(0.003, 0.015)
    longer, aside, faster = 1 + rng.normal(0, 0.015), 1 + abs(float(rng.normal(0, SLIDES))), 1 + rng.normal(0, 0.03)
    root = np.sqrt(np.abs(moves) @ [1.0, 1.0, 0.2])[:, None]
    noise = slip * root * rng.normal(size=moves.shape) * [1.0, 2.0, 0.5 / 0.3]
    ahead, left, turn = (moves * [longer, longer * aside, faster] + noise).T
    yaw = np.cumsum(turn)
    c, s = np.cos(yaw - turn / 2), np.sin(yaw - turn / 2)
    pose = np.column_stack([np.cumsum(ahead * c - left * s), np.cumsum(ahead * s + left * c), yaw])
    every = max(round(1 / (rate * step)), 1)
    true = {
        "odometry.scale": 1 / longer - 1,
        "odometry.lateral_scale": 1 / aside - 1,
        "odometry.turn_scale": 1 / faster - 1,
        "odometry.turn_bias": 0.0,
    }
    return Trajectory(stamps[::every], lift_se2(pose[::every])), true
