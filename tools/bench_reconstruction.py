"""Measure the error, the time and the memory of the reconstruction, on the demo's rendered drive.

    objslam demo -o demo_out
    python tools/bench_reconstruction.py demo_out [--seed 0] [--repeats 3] [--picture docs/reconstruction.png]

The tool fuses the depth images of the drive at the true poses, at the poses of the `fixed` and `joint` results, and at the
poses of the odometry. It prints the distance of each surface from the true room. A map from odometry alone has its own
frame, so its path is aligned with the true path first. Then the tool prints the time per frame, ms, as the best and the
median of all repeats, and the peak memory of a full grid.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from mesh_view import Picture, View, save
from one_line import end_with

from objslam.config import Settings, load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, interpolate, make_pose
from objslam.core.result import Surface
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import OutputError
from objslam.io.detections_jsonl import read_detections
from objslam.mapping import pipeline
from objslam.mapping.reconstruction import Grid, Lens, choose_shots, load_shot, reconstruct
from objslam.simulation.render import RenderSettings, drive_room
from objslam.sources import read

BAR_DISTANCE, BAR_TIME = 15.0, 10.0  # mm, ms


def true_room(seed: int) -> o3d.t.geometry.RaycastingScene:
    """The room of the demo's drive."""
    scene = o3d.t.geometry.RaycastingScene()
    for part in drive_room(RenderSettings(), seed).parts:
        vertices, triangles = part.vertices.astype(np.float32), part.triangles.astype(np.uint32)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    return scene


def moved(surface: Surface, pose: Floats) -> Surface:
    """The surface under a rigid motion (4, 4)."""
    turn = pose[:3, :3].astype(np.float32)
    return replace(
        surface, vertices=surface.vertices @ turn.T + pose[:3, 3].astype(np.float32), normals=surface.normals @ turn.T
    )


def laid(path: Trajectory, truth: Trajectory) -> Floats:
    """Return the pose (4, 4) of a path's frame in the true frame, from an alignment in the plane."""
    true, known = interpolate(truth.stamps, truth.poses, path.stamps, 1.0)
    return align(path.poses[known, :3, 3], true[known, :3, 3], "se2")[0]


def surfaces(log: Log, demo: Path) -> dict[str, Surface]:
    """Return the surface at each kind of poses. A surface in a frame of its own is moved onto the room."""
    assert log.truth is not None
    truth = log.truth.trajectory
    assert truth is not None
    found = {"true poses": reconstruct(log, truth, Settings(), Ledger())}
    for mode, poses in (("fixed", "localization"), ("joint", "odometry")):
        boxes = read_detections(demo / mode / "detections.jsonl", Ledger())
        with_boxes = replace(log, cameras=(replace(log.cameras[0], detections=boxes),))
        own = poses == "odometry"
        change = (f"reconstruction.before={str(own).lower()}",)
        result = pipeline.run(with_boxes, load_settings(demo / mode / "config.yaml", change), Ledger())
        assert result.surface is not None
        found[f"{mode}, from {poses}"] = moved(result.surface, laid(result.path_after, truth)) if own else result.surface
        if result.surface_before is not None:
            found["odometry as it is"] = moved(result.surface_before, laid(result.path, truth))
    return {name: surface for name, surface in found.items() if surface is not None}


def time_frames(log: Log, repeats: int) -> tuple[Floats, Floats, Floats]:
    """Return three times (repeats, frames), ms: of reading, of fusing, and the CPU time of all cores for fusing."""
    assert log.truth is not None
    assert log.truth.trajectory is not None
    settings, camera = Settings(), log.cameras[0].camera
    lens = Lens.of(camera)
    shots = choose_shots(log, log.truth.trajectory, settings, Ledger())
    reading, fusing, busy = np.zeros((3, repeats, len(shots)))
    for repeat in range(repeats):
        grid = Grid(settings, coloured=True)
        for i, shot in enumerate(shots):
            begin = time.perf_counter()
            depth, colour = load_shot(shot, camera, lens, settings.reconstruction.max_depth, Ledger())
            assert depth is not None
            middle, worked = time.perf_counter(), time.process_time()
            grid.add(depth, colour, camera.matrix, shot.map_T_camera)
            reading[repeat, i] = middle - begin
            fusing[repeat, i], busy[repeat, i] = time.perf_counter() - middle, time.process_time() - worked
    return 1e3 * reading, 1e3 * fusing, 1e3 * busy


def fill() -> None:
    """Fill a grid up to its bound, take the surface out, and print the memory, MB: before, with the full grid, and at the
    peak."""
    settings = Settings()
    depth, colour = np.full((480, 640), 3.0, np.float32), np.full((480, 640, 3), 0.5, np.float32)
    matrix = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    o3d.core.Tensor(depth)
    before = peak()
    grid, place = Grid(settings, coloured=True), 0
    while not grid.left_out:
        for _ in range(settings.reconstruction.min_views):
            grid.add(depth, colour, matrix, make_pose(np.eye(3), np.array([0.0, 0.0, 10.0 * place])))
        place += 1
    full = peak()
    grid.surface(settings.reconstruction.min_views)
    print(before, full, peak(), grid.blocks)


def peak() -> float:
    """The most memory so far, MB (getrusage would count the parent's too)."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


def picture(before: Surface, after: Surface, file: Path) -> None:
    """Both rooms from the same place, side by side."""
    view = View(np.array([2.1, -3.9, 3.4]), np.array([-0.2, 0.3, 0.6]), 62.0, 620, 480)
    images = []
    for surface, title in ((before, "odometry as it is"), (after, "joint: path and objects solved together")):
        image = np.ascontiguousarray(Picture(surface, view).done())
        cv2.putText(image, title, (14, 28), cv2.FONT_HERSHEY_DUPLEX, 0.62, (40, 44, 52), 1, cv2.LINE_AA)
        images.append(image)
    whole = np.hstack([images[0], np.full((view.height, 12, 3), 255, np.uint8), images[1]])
    save(whole, file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demo", type=Path, nargs="?", default=Path("demo_out"), help="what `objslam demo` made")
    parser.add_argument("--seed", type=int, default=0, help="the seed of the demo")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--picture", type=Path, help="write a PNG of the room at the odometry's poses and the solved poses")
    parser.add_argument("--fill", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.fill:
        fill()
        return
    for needed in (Path("log", "depth.txt"), *(Path(mode, "detections.jsonl") for mode in ("fixed", "joint"))):
        if not (args.demo / needed).is_file():
            hint = "`objslam demo` without --boxes makes one"
            raise OutputError(f"no rendered demo here: {needed} is missing", where=str(args.demo), hint=hint)
    log, scene = read(args.demo / "log", Ledger()), true_room(args.seed)
    found = surfaces(log, args.demo)
    print(f"{'poses':<24}{'mean mm':>10}{'median mm':>11}{'95 % mm':>9}{'vertices':>10}")
    for name, surface in found.items():
        off = 1e3 * scene.compute_distance(o3d.core.Tensor(surface.vertices)).numpy()
        row = f"{off.mean():10.1f}{np.median(off):11.1f}{np.quantile(off, 0.95):9.1f}{len(surface.vertices):10d}"
        solved = name.startswith(("fixed", "joint"))
        print(f"{name:<24}{row}  {verdict(off.mean(), BAR_DISTANCE, 'mm') if solved else ''}")
    if args.picture:
        picture(found["odometry as it is"], found["joint, from odometry"], args.picture)
    reading, fusing, busy = time_frames(log, args.repeats)
    best = fusing.min(axis=0).mean()
    print(
        f"fusing a 640x480 frame at 2 cm: {best:.1f} ms, best of {args.repeats} ({verdict(best, BAR_TIME, 'ms')});", end=" "
    )
    print(f"median of all {np.median(fusing):.1f} ms; processor time, all cores together, {busy.min(axis=0).mean():.1f} ms")
    print(f"reading it, PNG and JPEG (in a run, other threads do): {reading.min(axis=0).mean():.1f} ms")
    told = subprocess.run([sys.executable, __file__, "--fill"], capture_output=True, text=True, check=True).stdout
    before, full, most, blocks = (float(x) for x in told.split())
    print(
        f"a full grid, {blocks:.0f} blocks: {full - before:.0f} MB at most as it grew, {most - before:.0f} with the surface"
    )


def verdict(value: float, bar: float, unit: str) -> str:
    """Whether a value keeps within its bar."""
    return f"{'within' if value <= bar else 'NOT within'} {bar:g} {unit}"


if __name__ == "__main__":
    end_with(main)
