"""Simulated drives with known poses: how many objects are found, and how long that takes."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.global_association import associate_globally
from objslam.association.observations import PosedRays
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import widest_angle
from objslam.core.types import Association, Keyframes, Log, Rays
from objslam.evaluation.alignment import match_points
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.simulation import DriveSettings, pair, preset, simulate
from objslam.triangulation.triangulate import triangulate

LOCALIZATION = {"xy": 0.02, "yaw": 0.005}
"""The noise of the poses in the preset `large`, m and rad."""


@dataclass(frozen=True)
class Scene:
    """A drive without identities. whose: (R,) the true object of each ray, -1 for none."""

    log: Log
    keyframes: Keyframes
    rays: Rays
    whose: Ints
    cameras: tuple[Camera, ...]

    @property
    def points(self) -> Floats:
        """(N, 3) where the objects are."""
        assert self.log.truth is not None
        return np.array([o.position for o in self.log.truth.objects])

    @property
    def labels(self) -> Ints:
        """(N,) their labels, as indices into the rays' label_names."""
        assert self.log.truth is not None
        return np.array([self.rays.label_names.index(o.label) for o in self.log.truth.objects])


def make(settings: DriveSettings, seed: int, pixel_sigma: float) -> Scene:
    """Return a simulated drive, with the noise that the association assumes for its rays."""
    log = simulate(settings.model_copy(update={"tracks": "perfect"}), seed)
    chosen = Settings.model_validate({"rays": {"pixel_sigma": pixel_sigma}})
    keyframes = build_keyframes(log, chosen, Ledger())
    rays = build_rays(log, keyframes, chosen, Ledger())
    cameras = tuple(c.camera for c in log.cameras)
    return Scene(log, keyframes, replace(rays, track_id=np.full(len(rays), -1)), rays.track_id, cameras)


def solve(scene: Scene, exact_poses: bool = True) -> Association:
    """The association at the poses of the log."""
    sigma, place = scene.rays.sigma, 0.0
    if not exact_poses:
        sigma, place = np.hypot(sigma, LOCALIZATION["yaw"]), LOCALIZATION["xy"]
    posed = PosedRays(scene.rays, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, sigma, place)
    return associate_globally(posed, Settings())


def score(scene: Scene, association: Association, radius: float) -> tuple[int, int, float, Floats]:
    """Return the numbers of matched and of false objects, the recall, and the errors in m. The recall counts the objects
    with at least 10 rays, which span at least 10 degrees."""
    origins, directions = scene.rays.in_map(scene.keyframes.map_T_camera)
    settings = Settings().triangulation
    placed = triangulate(origins, directions, association.object, association.count, scene.rays.sigma, settings)
    same = association.label[placed.ok, None] == scene.labels
    found, true = match_points(placed.positions[placed.ok], scene.points, same, radius)
    mine = [directions[scene.whose == i] for i in range(len(scene.points))]
    well = np.array([len(d) >= 10 and widest_angle(d) >= np.radians(10) for d in mine])
    errors = np.linalg.norm(placed.positions[placed.ok][found] - scene.points[true], axis=1)
    return len(found), int(placed.ok.sum()) - len(found), float(well[true].sum() / max(well.sum(), 1)), errors


def scenes(seeds: int) -> None:
    """Print a line for each kind of room."""
    print(f"{'scene':42s} {'precision':>9s} {'recall':>7s} {'RMSE m':>8s} all right")
    quality("rooms: 15 objects of 3 classes", preset("rooms"), 3.0, seeds, 0.5)
    quality("hard: 24 of 3, two moving", preset("hard"), 5.0, seeds, 0.5)
    quality("hard, noise taken to be 3 px", preset("hard"), 3.0, seeds, 0.5)
    for distance in (0.25, 0.5):
        quality(f"pair {distance} m", pair(distance, pixel_sigma=3.0), 3.0, seeds, 0.1)
        strays = pair(distance, pixel_sigma=3.0, missed=0.2, false=0.2)
        quality(f"pair {distance} m, 20 % missed and false", strays, 3.0, seeds, 0.1)


def quality(name: str, settings: DriveSettings, pixel_sigma: float, seeds: int, radius: float) -> None:
    """Print precision, recall and RMSE over some seeds."""
    matched, false, recalls, errors, exact = 0, 0, [], [], 0
    for seed in range(seeds):
        scene = make(settings, seed, pixel_sigma)
        good, wrong, recall, error = score(scene, solve(scene), radius)
        matched, false = matched + good, false + wrong
        recalls.append(recall)
        errors.append(error)
        exact += good == len(scene.points) and wrong == 0
    rmse = float(np.sqrt((np.concatenate(errors) ** 2).mean()))
    precision = matched / max(matched + false, 1)
    print(f"{name:42s} {precision:9.4f} {np.mean(recalls):7.4f} {rmse:8.4f} {exact:4d} of {seeds}")


def speed(frames: int) -> None:
    """Print time and memory of one large log: 200 objects of 10 classes."""
    scene = make(preset("large", missed=0.2, false=0.2, frames=frames), 0, 2.0)
    begin, cpu = time.perf_counter(), time.process_time()
    association = solve(scene, exact_poses=False)
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    good, wrong, _, _ = score(scene, association, 0.5)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{len(scene.rays):8d} rays, {len(scene.keyframes):6d} frames: {wall:6.1f} s ({cpu:.1f} s of CPU), "
        f"{memory:.2f} GB, {good} of {len(scene.points)} objects, {wrong} false"
    )
