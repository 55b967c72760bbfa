"""Simulated drives past square fiducials, as logs with corners, with the truth beside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera, project
from objslam.core.geometry import align, exp_se3, inverse, lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log

BASE_T_CAMERA = make_pose(np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]), np.array([0.1, 0.0, 0.5]))  # It looks outwards.
SQUARE = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])


@dataclass(frozen=True)
class TagDrive:
    """map_T_tag: (T, 4, 4) by label. side: (T,) m. map_T_base: (K, 4, 4) at the stamps of the frames."""

    log: Log
    map_T_tag: dict[str, Floats]
    side: dict[str, float]
    map_T_base: Floats


def make_tag_drive(
    seed: int,
    *,
    pixel_sigma: float = 0.5,
    drift: float = 1.0,
    tags: int = 8,
    frames: int = 120,
    side: float = 0.16,
    reach: float = 1.6,
    stretch: float = 1.0,
    clockwise: bool = False,
    settings: Settings | None = None,
) -> TagDrive:
    """A drive on a circle of 1 m, around which tags hang, with odometry noise of `drift` times the settings.

    reach: m, the least distance from the circle to the tags. stretch: the scale of the odometry.
    """
    rng, noise = np.random.default_rng(seed), (settings or load_settings()).odometry
    turn = np.linspace(0, 2.4 * np.pi, frames)
    true = lift_se2(np.column_stack([np.sin(turn), -np.cos(turn), turn]))
    steps = inverse(true[:-1]) @ true[1:]
    way, yaw = np.linalg.norm(steps[:, :3, 3], axis=1), np.diff(turn)
    sigma = np.zeros((frames - 1, 6))
    sigma[:, 2] = np.sqrt(noise.yaw_per_m**2 * way + noise.yaw_per_rad**2 * yaw)
    sigma[:, 3] = np.sqrt(noise.x_per_m**2 * way + noise.xy_per_rad**2 * yaw)
    sigma[:, 4] = np.sqrt(noise.y_per_m**2 * way + noise.xy_per_rad**2 * yaw)
    steps = steps @ exp_se3(rng.normal(size=sigma.shape) * sigma * drift)
    steps[:, :3, 3] *= stretch
    odometry = [true[0]]
    for step in steps:
        odometry.append(odometry[-1] @ step)

    around = np.linspace(0, 2 * np.pi, tags, endpoint=False) + rng.uniform(-0.2, 0.2, tags)
    far = 1 + reach + rng.uniform(0, 1.5, tags)
    facing = around + np.pi + rng.uniform(-0.7, 0.7, tags)  # The normal, roughly towards the circle.
    roll = rng.uniform(-0.6, 0.6, tags)
    z = np.stack([np.cos(facing), np.sin(facing), np.zeros(tags)], axis=1)
    x = np.stack([-np.sin(facing), np.cos(facing), np.zeros(tags)], axis=1)
    x = x * np.cos(roll)[:, None] + np.array([0.0, 0.0, 1.0]) * np.sin(roll)[:, None]
    rotation = np.stack([x, np.cross(z, x), z], axis=2)
    place = np.column_stack([far * np.cos(around), far * np.sin(around), 0.5 + rng.uniform(-0.4, 0.4, tags)])
    map_T_tag = make_pose(rotation, place)
    sides = side * rng.uniform(0.8, 1.2, tags)

    order = np.array([3, 2, 1, 0]) if clockwise else np.arange(4)
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    camera = Camera("right", 640, 480, matrix, base_T_camera=BASE_T_CAMERA)
    square = SQUARE[order] * sides[:, None, None]
    corners = np.einsum("tij,tcj->tci", rotation, square) + place[:, None]
    map_T_camera = true @ BASE_T_CAMERA
    seen = np.einsum("kji,ktcj->ktci", map_T_camera[:, :3, :3], corners[None] - map_T_camera[:, None, None, :3, 3])
    towards = np.einsum("ti,kti->kt", z, map_T_camera[:, None, :3, 3] - place)
    with np.errstate(all="ignore"):
        pixels = project(camera, seen.reshape(-1, 3)).reshape(*seen.shape[:3], 2)
    pixels = pixels + rng.normal(size=pixels.shape) * pixel_sigma
    inside = (seen[..., 2] > 0.2).all(axis=2) & ((pixels > 0) & (pixels < [639, 479])).all(axis=(2, 3)) & (towards > 0.3)
    frame, tag = np.nonzero(inside)
    found = pixels[frame, tag]
    stamps = 0.1 * np.arange(frames)
    names = tuple(f"tag_{t}" for t in range(tags))
    detections = Detections(
        frame_stamps=stamps,
        frame=frame,
        boxes=np.concatenate([found.min(axis=1), found.max(axis=1)], axis=1),
        label=tag,
        scores=np.ones(len(frame)),
        depths=np.full(len(frame), np.nan),
        track_ids=np.full(len(frame), -1),
        label_names=names,
        whole=True,
        corners=found,
    )
    log = Log("tags", (CameraLog(camera, detections),), odometry=Trajectory(stamps, np.array(odometry)))
    return TagDrive(log, dict(zip(names, map_T_tag, strict=True)), dict(zip(names, sides.tolist(), strict=True)), true)


def scale_of(found: Floats, true: Floats) -> float:
    """How much larger points (N, 3) are than the true ones."""
    return 1 / align(found, true, "sim3")[1]
