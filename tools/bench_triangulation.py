"""Measure how fast objects are triangulated, and compare one batch with loops of scipy and torch over the objects.

    python tools/bench_triangulation.py [--objects 1000] [--rays 50] [--outliers 0.2] [--device cpu]

The tool solves Eq. 1 in one batch, by scipy (BFGS with the analytic gradient), and by Adam of torch, all from the same
start. It prints the CPU time and the rays per second of each and of the whole triangulation, the ratios of the times, and
the distances between the solutions.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.optimize import minimize

from objslam import config
from objslam.triangulation.triangulate import solve_eq1, triangulate


def scene(objects: int, rays: int, outliers: float, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (origins, directions, object index) from 2 to 5 m around each object; a share of them points elsewhere."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-20, 20, size=(objects, 1, 3))
    away = rng.normal(size=(objects, rays, 3)) * [1, 1, 0.2]
    away *= rng.uniform(2, 5, size=(objects, rays, 1)) / np.linalg.norm(away, axis=2, keepdims=True)
    directions = -away / np.linalg.norm(away, axis=2, keepdims=True) + noise * rng.normal(size=away.shape)
    wrong = rng.random((objects, rays, 1)) < outliers
    directions += np.where(wrong, 0.5, 0.0) * rng.normal(size=away.shape)
    return (places + away).reshape(-1, 3), directions.reshape(-1, 3), np.repeat(np.arange(objects), rays)


def scipy_loop(origins: np.ndarray, directions: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve Eq. 1 with scipy, one object after the other. Return solutions (N, 3) for rays (N, K, 3) and starts (N, 3)."""
    unit = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    solutions = np.empty_like(start)
    for i, (m, n) in enumerate(zip(origins, unit, strict=True)):

        def cost(o: np.ndarray, m: np.ndarray = m, n: np.ndarray = n) -> tuple[float, np.ndarray]:
            offset = o - m
            offset = offset - n * (offset * n).sum(axis=1, keepdims=True)
            distance = np.linalg.norm(offset, axis=1)
            return float(distance.sum()), (offset / distance[:, None]).sum(axis=0)

        solutions[i] = minimize(cost, start[i], jac=True, method="BFGS", options={"gtol": 1e-8}).x
    return solutions


def adam_loop(origins: np.ndarray, directions: np.ndarray, start: np.ndarray, steps: int = 300) -> np.ndarray:
    """Solve Eq. 1 with torch's Adam, one object after the other. Return solutions (N, 3) for rays (N, K, 3), starts (N,
    3)."""
    import torch

    torch.set_num_threads(1)
    unit = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    solutions = np.empty_like(start)
    for i in range(len(start)):
        m, n = torch.from_numpy(origins[i]), torch.from_numpy(unit[i])
        point = torch.tensor(start[i], requires_grad=True)
        optimiser = torch.optim.Adam([point], lr=0.01)
        for _ in range(steps):
            optimiser.zero_grad()
            torch.linalg.cross(point - m, n).norm(dim=1).sum().backward()
            optimiser.step()
        solutions[i] = point.detach().numpy()
    return solutions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=1000)
    parser.add_argument("--rays", type=int, default=50)
    parser.add_argument("--outliers", type=float, default=0.2, help="the share of rays that do not point at their object")
    parser.add_argument("--noise", type=float, default=0.006, help="the noise of the directions, rad")
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    parser.add_argument("--repeat", type=int, default=5, help="the runs, of which the fastest counts (scipy, Adam: one run)")
    parser.add_argument("--adam", type=int, default=10, help="the number of objects for Adam; its time is scaled to all")
    args = parser.parse_args()
    rays = scene(args.objects, args.rays, args.outliers, args.noise)
    number = args.objects * args.rays
    origins, directions = (one.reshape(args.objects, args.rays, 3) for one in rays[:2])
    unit = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    across = np.eye(3) - unit[..., None] * unit[..., None, :]
    start = np.linalg.solve(across.sum(axis=1), np.einsum("nrij,nrj->ni", across, origins)[..., None])[..., 0]
    settings = config.Triangulation(device=args.device)

    def fastest(work) -> float:
        work()  # the first call may import torch
        times = []
        for _ in range(args.repeat):
            begin = time.process_time()
            work()
            times.append(time.process_time() - begin)
        return min(times)

    batch = fastest(lambda: solve_eq1(*rays, args.objects, device=args.device))
    whole = fastest(lambda: triangulate(*rays, args.objects, args.noise, settings))
    begin = time.process_time()
    reference = scipy_loop(origins, directions, start)
    loop = time.process_time() - begin
    few = min(args.adam, args.objects)
    begin = time.process_time()
    slow = adam_loop(origins[:few], directions[:few], start[:few])
    adam = (time.process_time() - begin) * args.objects / few
    points, _, gradient = solve_eq1(*rays, args.objects, device=args.device)
    apart = np.linalg.norm(points - reference, axis=1)
    print(f"{args.objects} objects x {args.rays} rays, {100 * args.outliers:g} % of them wrong, device {args.device}")
    for name, seconds in (
        ("Eq. 1, one batch", batch),
        ("Eq. 1, scipy loop", loop),
        ("Eq. 1, Adam loop", adam),
        ("whole triangulation", whole),
    ):
        print(f"{name:<22}{seconds:9.3f} s{number / seconds:14,.0f} rays/s")
    print(f"the batch is {loop / batch:.1f} times as fast as the loop of scipy, {adam / batch:.0f} times that of Adam")
    print(
        f"solutions apart: median {np.median(apart):.1e} m, most {apart.max():.1e} m; gradient at most {gradient.max():.1e}"
    )
    print(f"Adam's solutions are up to {np.linalg.norm(slow - points[:few], axis=1).max():.1e} m away after 300 steps")


if __name__ == "__main__":
    main()
