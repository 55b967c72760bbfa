"""Simulated drives as the graph takes them, with the truth beside: every label is one object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Odometry, Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import align, angles_off, interpolate, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, Camera, CameraLog, Detections, Keyframes, Log, Rays, Truth, TruthObject
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.graph.batch_solver import solve_fixed, solve_joint
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.simulation import make_camera, preset, simulate

ODOMETRY_ALONE: dict[str, Any] = {"localization": None, "odometry": Odometry()}


@dataclass(frozen=True)
class Drive:
    """points: (N, 3) where the objects are. map_T_base: (K, 4, 4) where the robot was."""

    keyframes: Keyframes
    rays: Rays
    association: Association
    settings: Settings
    points: Floats
    map_T_base: Floats

    def fixed(self) -> Estimate:
        placed = triangulate_at(self.keyframes.map_T_camera, self.keyframes, self.rays, self.association, self.settings)
        return solve_fixed(self.keyframes, self.rays, self.association, placed, self.settings)

    def joint(self, **more: Any) -> Estimate:
        return solve_joint(self.keyframes, self.rays, self.association, self.settings, Ledger(), **more)

    def object_errors(self, positions: Floats, alignment: str = "none") -> Floats:
        """(N,) m; NaN where there is no position."""
        there = np.isfinite(positions[:, 0])
        pose, scale = align(positions[there], self.points[there], alignment)
        return np.linalg.norm(scale * positions @ pose[:3, :3].T + pose[:3, 3] - self.points, axis=1)

    def ate(self, map_T_base: Floats) -> float:
        """Root mean square distance of the robot's places from the true ones, m, without alignment."""
        return float(np.sqrt((np.linalg.norm((map_T_base - self.map_T_base)[:, :3, 3], axis=1) ** 2).mean()))

    def scale(self, positions: Floats) -> float:
        """How much larger the map is than the truth."""
        there = np.isfinite(positions[:, 0])
        return 1 / align(positions[there], self.points[there], "sim2")[1]

    def right(self) -> np.ndarray:
        """(R,) whether a ray, at the true pose, meets its object as closely as its noise lets."""
        origins, directions = self.rays.in_map(self.map_T_base @ self.keyframes.base_T_camera)
        return angles_off(origins, directions, self.points[self.association.object]) < 4 * self.rays.sigma


def make_drive(seed: int, *overrides: str, stretch: float = 1.0, **changes: Any) -> Drive:
    """A drive of the demo's room with overrides of the settings; stretch: the scale of its odometry."""
    settings = load_settings(None, ("rays.pixel_sigma=2", *overrides))
    log = simulate(preset("demo", **{"objects": 12, "classes": 12, "frames": 200, **changes}), seed)
    return drive_of(_stretched(log, stretch), settings)


def drive_of(log: Log, settings: Settings) -> Drive:
    ledger = Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    rays = build_rays(log, keyframes, settings, ledger)
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)  # as a run does: no keyframe without a ray
    keyframes, rays = keyframes.take(kept), replace(rays, keyframe=keyframe)
    association = associate_by_label(rays)
    place = {o.label: o.position for o in log.truth.objects}
    true = log.truth.trajectory
    return Drive(
        keyframes=keyframes,
        rays=rays,
        association=association,
        settings=settings,
        points=np.array([place[rays.label_names[label]] for label in association.label]),
        map_T_base=interpolate(true.stamps, true.poses, keyframes.stamps, 1.0)[0],
    )


def _stretched(log: Log, stretch: float) -> Log:
    if log.odometry is None or stretch == 1:
        return log
    poses = log.odometry.poses.copy()
    poses[:, :3, 3] = poses[0, :3, 3] + stretch * (poses[:, :3, 3] - poses[0, :3, 3])
    return replace(log, odometry=Trajectory(log.odometry.stamps, poses))


def circle_log(
    seed: int, frames: int, clock: float, *, radius: float = 4.0, turn_noise: float = 0.004, commanded: bool = False
) -> Log:
    """Laps on a circle at one speed, between 40 labelled objects. The odometry has one pose a frame, and measures each step.

    commanded: whether the odometry has the commanded steps, and the robot the noise.
    clock: how much later, in s, the camera's stamps are than the odometry's. turn_noise: rad a step.
    """
    rng = np.random.default_rng(seed)
    apart, speed, focal = 0.2, 0.5, 400.0
    stamps = apart * np.arange(frames)
    turn, arc = speed * stamps / radius, speed * apart
    path = np.column_stack([radius * np.sin(turn), radius * (1 - np.cos(turn)), turn])
    steps = np.array([arc, 0.0, arc / radius]) + rng.normal(size=(frames - 1, 3)) * [0.004, 0.002, turn_noise]
    yaw = np.append(0.0, np.cumsum(steps[:, 2]))
    c, s = np.cos(yaw[:-1] + steps[:, 2] / 2), np.sin(yaw[:-1] + steps[:, 2] / 2)
    ways = np.column_stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]])
    said = np.column_stack([np.vstack([np.zeros(2), np.cumsum(ways, axis=0)]), yaw])
    if commanded:
        path, said = said, path
    around, out = rng.uniform(0, 2 * np.pi, 40), radius + rng.choice([-1, 1], 40) * rng.uniform(1, 2.5, 40)
    points = np.column_stack([out * np.sin(around), radius - out * np.cos(around), rng.uniform(0.2, 1.0, 40)])
    base_T_camera = make_camera(position=(0.0, 0.0, 0.5)).base_T_camera
    there = lift_se2(path) @ base_T_camera
    seen = np.einsum("kji,knj->kni", there[:, :3, :3], points - there[:, None, :3, 3])
    pixel = focal * seen[..., :2] / np.maximum(seen[..., 2:], 1e-6) + [640.0, 360.0]
    inside = (seen[..., 2] > 0.5) & (seen[..., 2] < 6) & ((pixel > 40) & (pixel < [1240, 680])).all(axis=2)
    frame, label = np.nonzero(inside)
    middle = pixel[inside] + rng.normal(scale=1.0, size=(len(frame), 2))
    depth = seen[..., 2][inside] * (1 + rng.normal(scale=0.02, size=len(frame)))
    names = tuple(f"object {i}" for i in range(40))
    boxes, none = np.hstack([middle - 10, middle + 10]), np.full(len(frame), -1)
    whole = np.ones(len(frame))
    found = Detections(stamps - clock, frame, boxes, label, whole, depth, none, names, whole=True)
    matrix = np.array([[focal, 0, 640.0], [0, focal, 360.0], [0, 0, 1]])
    camera = Camera("front", 1280, 720, matrix, base_T_camera=base_T_camera, sees_size=False)
    truth = Truth(tuple(TruthObject(i, names[i], points[i]) for i in range(40)), Trajectory(stamps, lift_se2(path)))
    return Log(name="circle", cameras=(CameraLog(camera, found),), odometry=Trajectory(stamps, lift_se2(said)), truth=truth)
