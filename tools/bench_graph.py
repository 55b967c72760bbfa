"""Measure how the CPU time to build and solve a graph grows with the log, and compare with GTSAM's CustomFactor.

python tools/bench_graph.py               # everything, a few minutes, most of them for the CustomFactor
python tools/bench_graph.py --skip-custom
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "graph"))
from custom_factor import eq1_factor

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3, inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.odometry_drift import gathered_drift
from objslam.graph.batch_solver import solve_fixed, solve_joint
from objslam.graph.factors.bearing import bearings, point_to_line
from objslam.graph.factors.noise import robust
from objslam.graph.factors.odometry import betweens, motions
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import L0, X0, make_values

RAYS_A_FRAME = 5
PIXEL = 3.0 / 500


def drive(rays_total: int, seed: int = 0) -> tuple[Keyframes, Rays, Association, np.ndarray]:
    """Return a drive on laps of 60 m, with one object for 200 rays and 5 rays for a keyframe. The last value is the
    truth."""
    rng = np.random.default_rng(seed)
    k = rays_total // RAYS_A_FRAME
    objects = max(20, rays_total // 200)
    along = np.arange(k) * 0.1
    radius = 60 / (2 * np.pi) * max(1.0, np.sqrt(objects / 20))
    phi = along / radius
    truth = lift_se2(np.column_stack([radius * np.sin(phi), radius * (1 - np.cos(phi)), phi]))
    ring = rng.uniform(0, 2 * np.pi, objects)
    out = radius + rng.choice([-1, 1], objects) * rng.uniform(1.5, 4, objects)
    points = np.column_stack([out * np.sin(ring), radius - out * np.cos(ring), rng.uniform(0.1, 1.5, objects)])
    base_T_camera = np.array([[0, 0, 1, 0.0], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])
    camera = inverse(truth @ base_T_camera)
    keyframe, landmark = [], []
    for first in range(0, k, 2000):  # in chunks: poses times objects would not fit at once
        local = (
            np.einsum("kij,nj->kni", camera[first : first + 2000, :3, :3], points)
            + camera[first : first + 2000, None, :3, 3]
        )
        near = np.linalg.norm(local, axis=2) + 100.0 * (local[:, :, 2] < 0.3)
        nearest = np.argpartition(near, RAYS_A_FRAME, axis=1)[:, :RAYS_A_FRAME]
        keyframe.append(np.repeat(np.arange(first, first + len(local)), RAYS_A_FRAME))
        landmark.append(nearest.ravel())
    key, mark = np.concatenate(keyframe), np.concatenate(landmark)
    to = np.einsum("rij,rj->ri", camera[key][:, :3, :3], points[mark]) + camera[key][:, :3, 3]
    direction = to / np.linalg.norm(to, axis=1, keepdims=True) + rng.normal(scale=PIXEL, size=to.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    settings = Settings().odometry
    sigma = np.array(
        [0, 0, np.hypot(settings.yaw_per_m, settings.yaw_per_rad / radius), settings.x_per_m, settings.y_per_m, 0]
    )
    steps = inverse(truth[:-1]) @ truth[1:] @ exp_se3(rng.normal(size=(k - 1, 6)) * sigma * np.sqrt(0.1))
    odom = np.empty_like(truth)
    odom[0] = truth[0]
    for i in range(1, k):
        odom[i] = odom[i - 1] @ steps[i - 1]
    stamps = np.arange(k) * 0.2
    r = len(key)
    keyframes = Keyframes(
        stamps=stamps,
        camera=np.zeros(k, dtype=np.int64),
        frame=np.arange(k),
        base_T_camera=np.tile(base_T_camera, (k, 1, 1)),
        map_T_base=odom,
        odom_T_base=odom,
        drift=gathered_drift(Trajectory(stamps, odom), stamps, settings),
    )
    rays = Rays(
        keyframe=key,
        direction=direction,
        sigma=np.full(r, PIXEL),
        range=np.full(r, np.nan),
        range_sigma=np.full(r, np.nan),
        range_bias=np.full(r, np.nan),
        label=np.zeros(r, dtype=np.int64),
        score=np.ones(r),
        box=np.zeros((r, 4)),
        track_id=np.full(r, -1),
        label_names=("object",),
    )
    return keyframes, rays, Association(mark, np.zeros(objects, dtype=np.int64)), points


def against_custom(rays_total: int, iterations: int = 3) -> float:
    """Return the CPU time of the CustomFactor divided by that of the compiled factor. Graph, start and iterations are the
    same."""
    keyframes, rays, association, points = drive(rays_total)
    noise = [gtsam.noiseModel.Isotropic.Sigma(2, 0.05)] * len(rays)
    every = np.arange(len(keyframes))
    between = betweens(every[:-1], every[1:], *motions(keyframes, Settings()))
    seconds = []
    for custom in (False, True):
        begin = time.process_time()
        if custom:
            sigma = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
            made = [
                eq1_factor((X0 + k), (L0 + j), n, sigma)
                for k, j, n in zip(rays.keyframe, association.object, rays.direction, strict=True)
            ]
        else:
            made = point_to_line(rays.keyframe, rays.direction, association.object, noise)
        prior = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
        first = gtsam.PriorFactorPose3((X0 + 0), gtsam.Pose3(keyframes.map_T_camera[0]), prior)
        seen = np.unique(association.object)
        graph = build_graph(made, between, [first])
        values = make_values(keyframes.map_T_camera, points, seen)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(iterations)
        parameters.setRelativeErrorTol(0)
        parameters.setAbsoluteErrorTol(0)
        gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        seconds.append(time.process_time() - begin)
    print(f"{rays_total:7d} rays, {iterations} LM iterations: compiled {seconds[0]:.3f} s, CustomFactor {seconds[1]:.2f} s")
    return seconds[1] / seconds[0]


def growth() -> None:
    """Print the CPU time to build and solve growing logs, and the exponent of the growth."""
    sizes = [5_000, 10_000, 20_000, 50_000]
    table: dict[str, list[float]] = {"joint graph": [], "fixed": [], "joint from odometry": []}
    settings = Settings(mode="joint")
    drive_ = drive(2_000)
    solve_joint(*drive_[:3], settings, Ledger())  # first use loads and warms what is measured
    for size in sizes:
        keyframes, rays, association, points = drive(size)
        begin = time.process_time()
        estimate = solve_joint(keyframes, rays, association, settings, Ledger())
        table["joint from odometry"].append(time.process_time() - begin)
        error = np.linalg.norm(estimate.positions - points, axis=1)[estimate.solved]
        begin = time.process_time()
        # one solve alone, from the poses that the first one found
        noise = robust("huber", rays.sigma, 2)
        graph = build_graph(
            bearings(rays.keyframe, rays.direction, association.object, noise),
            betweens(np.arange(len(keyframes) - 1), np.arange(1, len(keyframes)), *motions(keyframes, settings)),
            [
                gtsam.PriorFactorPose3(
                    (X0 + 0), gtsam.Pose3(keyframes.map_T_camera[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
                )
            ],
        )
        moved = (estimate.map_T_base @ keyframes.base_T_camera) @ exp_se3(
            np.random.default_rng(1).normal(scale=0.01, size=(len(keyframes), 6))
        )
        values = make_values(
            moved, np.where(np.isfinite(estimate.positions), estimate.positions, points), np.unique(association.object)
        )
        gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        table["joint graph"].append(time.process_time() - begin)
        begin = time.process_time()
        placed = triangulate_at(keyframes.map_T_camera, keyframes, rays, association, settings)
        solve_fixed(keyframes, rays, association, placed, settings)
        table["fixed"].append(time.process_time() - begin)
        print(
            f"{size:7d} rays, {len(keyframes)} keyframes, {association.count} objects: "
            + ", ".join(f"{name} {times[-1]:.2f} s" for name, times in table.items())
            + f"; object error median {np.median(error):.3f} m, {estimate.solved.sum()} solved"
        )
    for name, times in table.items():
        print(f"{name}: growth exponent {np.polyfit(np.log(sizes), np.log(times), 1)[0]:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skip-custom", action="store_true", help="leave out the slow CustomFactor")
    arguments = parser.parse_args()
    growth()
    if not arguments.skip_custom:
        for size in (4_000, 20_000):
            print(f"  ratio {against_custom(size):.0f}x")


if __name__ == "__main__":
    main()
