"""Bodies of things of many shapes on the floor: errors of centres, and whether the sigmas hold them.

    python tools/bench_shapes.py [--things 30] [--boxes 24] [--noise 2]

A camera at a height of 0.7 m sees each thing from 2 to 4 m, over an arc of azimuths. Its boxes go around the true outline,
with noise on each edge. Ellipsoids, cuboids and cylinders are shapes of bodies. The others are not: a flowerpot is wider at
its top, a cone at its bottom, a hexagon is a prism, a seat has a back, a monitor a stand, a person shoulders. All things of
a row have one label. Real boxes also err in ways that repeat from a side, so real sigmas are larger than these.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from outlines import looking_at
from triangulation.true_boxes import CAMERAS, box_around, edges_of

from objslam.core.arrays import Floats
from objslam.mapping.bodies.fitting import repeated_error
from objslam.triangulation.bodies.solve import solve_bodies

CAMERA = CAMERAS["pinhole"]
CHI2_95 = 7.815  # chi-squared, 3 degrees of freedom
HEIGHT, NEAR, FAR = 0.7, 2.0, 4.0  # m, of the camera above the floor, and its distances.
PIXEL_SIGMA = 3 * np.sqrt(2)  # px, of an edge, by the default of rays.pixel_sigma.
ROUND = ("cylinder", "flowerpot", "cone")
CIRCLE = np.linspace(0, 2 * np.pi, 40, endpoint=False)


def rings(*profile: tuple[float, float, float]) -> Floats:
    """Return points on rings: half axes along x and y, and the height, all from -1 to 1."""
    return np.concatenate(
        [np.column_stack([x * np.cos(CIRCLE), y * np.sin(CIRCLE), np.full(len(CIRCLE), z)]) for x, y, z in profile]
    )


def block(x: float, y: float, low: float, high: float) -> Floats:
    """Return the corners of a cuboid with half axes x and y, from one height to another."""
    return np.array([[i * x, j * y, z] for i in (-1, 1) for j in (-1, 1) for z in (low, high)])


SHAPES = {
    "ellipsoid": rings(*[(np.cos(a), np.cos(a), np.sin(a)) for a in np.linspace(-1.55, 1.55, 30)]),
    "cuboid": block(1, 1, -1, 1),
    "cylinder": rings((1, 1, -1), (1, 1, 1)),
    "flowerpot": rings((0.6, 0.6, -1), (1, 1, 1)),
    "cone": rings((1, 1, -1), (0.2, 0.2, 1)),
    "hexagon": np.concatenate([rings((1, 1, z))[::7] for z in (-1, 1)]),
    "seat": np.concatenate([block(1, 1, -1, 0), [[-1, -1, 1], [-1, 1, 1]]]),
    "monitor": np.concatenate([block(0.15, 1, -0.4, 1), block(0.4, 0.5, -1, -1)]),
    "person": rings((0.5, 0.25, -1), (1, 0.5, 0.6), (0.3, 0.15, 1)),
}


def views(outline: Floats, boxes: int, arc: float, noise: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return boxes (B, 4), px, of points around the origin, and the poses (B, 4, 4) that see them, over an arc, rad."""
    begin, seen, poses = rng.uniform(0, 6), [], []
    for azimuth in begin + np.linspace(0, arc, boxes):
        away = rng.uniform(NEAR, FAR)
        place = np.array([away * np.cos(azimuth), away * np.sin(azimuth), HEIGHT + outline[:, 2].min()])
        poses.append(looking_at(place, np.zeros(3)))
        seen.append(box_around(CAMERA, outline, poses[-1]))
    return np.array(seen) + rng.normal(0, noise, (boxes, 4)), np.array(poses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--things", type=int, default=30, help="things of each shape")
    parser.add_argument("--boxes", type=int, default=24, help="boxes of each thing")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of each edge, px")
    options = parser.parse_args()
    print(f"{'shape':<10}{'arc deg':>8}{'level mm':>10}{'height mm':>11}{'inside 95 %':>13}{'median Mahalanobis^2':>22}")
    for name, unit in SHAPES.items():
        for arc in (30.0, 115.0, 285.0):
            off, squared = measured(unit, name, options, np.radians(arc))
            level, height = np.median(np.hypot(off[:, 0], off[:, 1])), np.median(np.abs(off[:, 2]))
            print(
                f"{name:<10}{arc:8.0f}{1e3 * level:10.1f}{1e3 * height:11.1f}{np.mean(squared < CHI2_95):13.0%}"
                f"{np.median(squared):22.2f}",
                flush=True,
            )


def measured(unit: Floats, name: str, options: argparse.Namespace, arc: float) -> tuple[Floats, Floats]:
    """Return the errors (N, 3), m, of the centres of random things of one shape, and their squared Mahalanobis errors (N,).

    unit: (P, 3) the outline, from -1 to 1. arc: rad, of the views.
    """
    rng, many = np.random.default_rng(8), options.things
    half = rng.uniform([0.15, 0.15, 0.15], [0.3, 0.3, 0.4], (many, 3))
    if name in ROUND:
        half[:, 1] = half[:, 0]
    yaw = rng.uniform(0, 3, many)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]).transpose(2, 0, 1)
    outlines = [np.column_stack([(unit * h)[:, :2] @ t, unit[:, 2] * h[2]]) for h, t in zip(half, turn, strict=True)]
    seen = [views(outline, options.boxes, arc, options.noise, rng) for outline in outlines]
    boxes, poses = (np.concatenate(part) for part in zip(*seen, strict=True))
    edges = edges_of(CAMERA, boxes, poses, np.repeat(np.arange(many), options.boxes), sigma=PIXEL_SIGMA)
    points, side = rng.normal(0, 0.05, (many, 3)), np.full(len(boxes), 277.0)
    found = solve_bodies(lambda _: edges, points, half[:, [0, 2]], (name,) * many, side=side, share=0.1, bent=False)
    repeated = np.array([repeated_error(found.share[0], axes) for axes in found.axes[:, 3:6]])
    covariance = found.centre_covariance + found.unlike[:, :3, :3] + repeated[:, None, None] ** 2 * np.eye(3)
    off = found.axes[:, :3]
    return off, np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)


if __name__ == "__main__":
    main()
