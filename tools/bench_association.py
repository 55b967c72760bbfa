"""Measure how well association finds objects whose identities are unknown, and how long it takes.

    python tools/bench_association.py [--seeds 20] [--parts scenes speed drift ...] [--picture PNG]

scenes: simulated drives with known poses. speed: the time and memory for a short and a long log. drift: simulated drives
from odometry alone, whose poses and objects are estimated together. unnamed: drives of peers/drives.py, mapped with and
without the names of their landmarks (tools/bench_recordings.py has more recordings without names). street: poles seen from
a few places with the noise of GPS, beside a Markov random field. appearance: clusters of objects of one label, with and
without appearance vectors, of which a fifth confuse the object.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from log_parts import without_names
from peers.drives import drives
from peers.krylov import locate
from peers.street import Street, simulate_street

from objslam.association.global_association import associate_globally
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, widest_angle
from objslam.core.types import Association, Keyframes, Log, Rays
from objslam.evaluation.alignment import lay_truth, match_points
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.mapping import pipeline
from objslam.output.plot.map_plot import draw_map
from objslam.simulation import AppearanceNoise, DriveSettings, PoseNoise, pair, preset, simulate
from objslam.triangulation.triangulate import triangulate

PARTS = ("scenes", "speed", "drift", "unnamed", "street", "appearance")
UNNAMED = ("lost in the woods", "Victoria Park")
"""The drives of the part `unnamed`."""
STEP_DRIFT = {
    **{"x_per_m": 0.0, "y_per_m": 0.0, "xy_per_rad": 0.0, "yaw_per_m": 0.0, "yaw_per_rad": 0.0},
    **{"floor_xy": 0.01, "floor_yaw": float(np.radians(0.3))},
}
"""The odometry noise of one step in the preset `drift`."""
CLUSTERS, EACH, APART = 5, 3, 0.35
"""The number of clusters in the part `appearance`, the objects in each, and the distance (m) between two of them."""
ROUGH = PoseNoise(xy=0.02, yaw=float(np.radians(0.6)))
"""The odometry noise of one step in the part `appearance`. It is twice the noise of the preset `drift`."""
LOCALIZATION = {"xy": 0.02, "yaw": 0.005}
"""The noise of the poses in the preset `large`, m and rad."""


@dataclass(frozen=True)
class Scene:
    """A drive without identities; whose: (R,) the true object of each ray, -1 none."""

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
    """A simulated drive, with the noise that the rays are taken to have."""
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
    return associate_globally(
        scene.rays,
        scene.keyframes,
        scene.cameras,
        Settings(),
        map_T_camera=scene.keyframes.map_T_camera,
        sigma=sigma,
        position_sigma=place,
    )


def score(scene: Scene, association: Association, radius: float) -> tuple[int, int, float, Floats]:
    """Matched and false objects, recall of those seen by 10 rays and more under 10 degrees and more, errors in m."""
    origins, directions = scene.rays.in_map(scene.keyframes.map_T_camera)
    settings = Settings().triangulation
    placed = triangulate(origins, directions, association.object, association.count, scene.rays.sigma, settings)
    same = association.label[placed.ok, None] == scene.labels
    found, true = match_points(placed.positions[placed.ok], scene.points, same, radius)
    mine = [directions[scene.whose == i] for i in range(len(scene.points))]
    well = np.array([len(d) >= 10 and widest_angle(d) >= np.radians(10) for d in mine])
    errors = np.linalg.norm(placed.positions[placed.ok][found] - scene.points[true], axis=1)
    return len(found), int(placed.ok.sum()) - len(found), float(well[true].sum() / max(well.sum(), 1)), errors


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


def drift(seeds: int, picture: Path | None) -> None:
    """Print F1 and the path's error against dead reckoning's, of drives mapped from odometry alone."""
    print(f"{'drift, seed':<14}{'F1':>7}{'ATE m':>9}{'dead reckoning m':>18}{'ratio':>7}{'s':>7}")
    scores, ratios = [], []
    for seed in range(seeds):
        log = simulate(preset("drift"), seed)
        settings = Settings.model_validate({"mode": "joint", "rays": {"pixel_sigma": 3.0}, "odometry": STEP_DRIFT})
        begin = time.perf_counter()
        result = pipeline.run(log, settings, Ledger())
        seconds = time.perf_counter() - begin
        assert log.odometry is not None
        assert log.truth is not None
        if picture is not None and seed == 0:
            draw_map(result, picture, lay_truth(result.map, log.truth))
        found = evaluate(result.map, log.truth, result.path_after, align="se2", radius=0.5)
        dead = evaluate(result.map, log.truth, log.odometry, align="se2", radius=0.5)
        assert found.path is not None
        assert dead.path is not None
        ate, before = (float(np.sqrt(np.mean(e.path.errors**2))) for e in (found, dead))
        objects = found.objects
        f1 = 2 * len(objects.matches) / max(2 * len(objects.matches) + len(objects.false) + len(objects.missed), 1)
        scores.append(f1)
        ratios.append(ate / before)
        print(f"{seed:<14}{f1:>7.3f}{ate:>9.3f}{before:>18.3f}{ate / before:>7.2f}{seconds:>7.1f}")
    worse = int((np.array(ratios) > 1 / 3).sum())
    print(f"{'mean':<14}{np.mean(scores):>7.3f}{'':>27}{np.mean(ratios):>7.2f}   above a third: {worse} of {seeds}")


def unnamed() -> None:
    """Print what is left of the names of landmarks after a run without them, and how far its path is from the named one.

    F1 counts pairs of observations: a pair is right if the run and the names both say that it is one landmark.
    """
    columns = f"{'landmarks':>10}{'of':>5}{'F1 of pairs':>12}{'path off m':>12}{'dead reckoning m':>18}{'CPU s':>7}"
    print(f"{'names hidden':<20}{columns}")
    data = os.environ.get("OBJSLAM_DATA")
    for name, known in drives(Path(data) if data else None).items():
        if name not in UNNAMED:
            continue
        if isinstance(known, str):
            print(f"{name:<20} left out, {known}")
            continue
        log, settings = known().log, Settings.model_validate({"mode": "joint", "output": {"recording": False}})
        named = pipeline.run(log, settings, Ledger())
        begin = time.process_time()
        result = pipeline.run(without_names(log), settings, Ledger())
        seconds = time.process_time() - begin
        assert np.array_equal(named.rays.keyframe, result.rays.keyframe)  # the same rays in the same order
        found, truth = result.association.object, named.rays.label
        off = path_off(result.map_T_base, named.map_T_base)
        dead = result.keyframes.odom_T_base
        assert dead is not None
        print(
            f"{name:<20}{len(result.map.resolved()):>10}{len(np.unique(truth)):>5}{pair_f1(found, truth):>12.3f}"
            f"{off:>12.3f}{path_off(dead, named.map_T_base):>18.3f}{seconds:>7.1f}",
            flush=True,
        )


def street(seeds: int) -> None:
    """Print how many poles of simulated streets are found within 4 m, and how often an existence is right.

    Precision counts all found objects, recall those poles that were seen twice or more. The Markov random field runs with
    its authors' distance between crossings of one object, and with three times this distance, which suits this noise better.
    """
    said: list[tuple[float, bool]] = []
    rows: dict[str, Ints] = {}
    begin = time.process_time()
    for seed in range(seeds):
        scene = simulate_street(seed)
        for name, told in (("objslam, noise told", True), ("objslam, noise not told", False)):
            result = pipeline.run(scene.log, scene.settings(told), Ledger())
            objects = result.map.resolved()
            points = np.array([o.position[:2] for o in objects]).reshape(-1, 2)
            counts, right = street_counts(scene, points)
            rows[name] = rows.get(name, np.zeros(4, dtype=np.int64)) + counts
            if told:
                said += [(o.existence, i in right) for i, o in enumerate(objects) if o.existence is not None]
        for metres in (1.0, 3.0):
            points = locate(scene.origin, scene.heading, scene.range, scene.place, seed, metres)
            name = f"Markov random field, {metres:g} m"
            rows[name] = rows.get(name, np.zeros(4, dtype=np.int64)) + street_counts(scene, points)[0]
    print(f"{'street':<28}{'precision':>10}{'recall':>8}   ({seeds} seeds, {time.process_time() - begin:.0f} s of CPU)")
    for name, (right_count, found, twice, of) in rows.items():
        print(f"{name:<28}{right_count / max(found, 1):>10.3f}{twice / max(of, 1):>8.3f}")
    existence, hit = np.array([e for e, _ in said]), np.array([h for _, h in said])
    for low in np.arange(0.5, 1.0, 0.1).tolist():
        mine = (existence >= low) & (existence < low + 0.1 + 1e-6)
        if mine.any():
            print(
                f"existence {low:.1f} to {low + 0.1:.1f}: {int(mine.sum()):5d} objects, {hit[mine].mean():.2f} of them right"
            )


def street_counts(scene: Street, points: Floats) -> tuple[Ints, set[int]]:
    """Return the numbers of points (N, 2) that are right, of points, of poles seen twice that are found, and of such poles.
    Also return the points that are right."""
    found, true = match_points(points, scene.objects, np.ones((len(points), len(scene.objects)), dtype=bool), 4.0)
    twice = scene.views >= 2
    return np.array([len(found), len(points), twice[true].sum(), twice.sum()]), set(found.tolist())


def appearance(seeds: int) -> None:
    """Print the F1 of clusters of one label without and with appearance vectors, and the share of the missing F1 gained.

    Objects are found within 0.25 m. Joint runs take about ten times as long, so they get half of the seeds.
    """
    print(f"{'vectors that confuse 20 %':<30}{'F1':>13}{'gained':>8}{'F1 of pairs':>16}{'gained':>8}{'CPU s':>14}")
    for name, pixels, odometry, some in (
        ("coarse bearings, 15 px", 15.0, None, seeds),
        ("coarse bearings, 25 px", 25.0, None, seeds),
        ("noisy odometry, joint", 3.0, ROUGH, max(seeds // 2, 1)),
    ):
        rows = []
        for seed in range(some):
            scene = make(clusters(seed, pixels, odometry), seed, pixels)
            bare = replace(scene, rays=replace(scene.rays, feature=None, feature_table=None))
            rows.append([*clusters_found(bare, odometry), *clusters_found(scene, odometry)])
        f1, pairs, seconds, f1_with, pairs_with, seconds_with = np.mean(rows, axis=0).tolist()
        print(
            f"{name:<30}{f1:>6.3f} {f1_with:>6.3f}{(f1_with - f1) / max(1 - f1, 1e-9):>8.2f}"
            f"{pairs:>9.3f} {pairs_with:>6.3f}{(pairs_with - pairs) / max(1 - pairs, 1e-9):>8.2f}"
            f"{seconds:>7.2f} {seconds_with:>6.2f}   ({some} seeds)",
            flush=True,
        )


def clusters(seed: int, pixels: float, odometry: PoseNoise | None) -> DriveSettings:
    """A drive around clusters along the walls. Each object has 20 boxes and more under 60 degrees and more."""
    rng = np.random.default_rng([seed, CLUSTERS])
    noise = {"pixel_sigma": pixels, "missed": 0.2, "false": 0.2, "appearance": AppearanceNoise()}
    if odometry is not None:
        noise |= {"odometry": odometry, "localization": None, "laps": 2.0}
    while True:
        centres = rng.uniform([-3.6, -2.6], [3.6, 2.6], (CLUSTERS, 2))
        turn, height = rng.uniform(0, 2 * np.pi, CLUSTERS), rng.uniform(0.3, 0.6, (CLUSTERS, EACH))
        angle = turn[:, None] + 2 * np.pi * np.arange(EACH) / EACH
        around = APART / (2 * np.sin(np.pi / EACH)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        places = np.dstack([centres[:, None] + around, height]).reshape(-1, 3)
        if (np.abs(centres) < [2.9, 1.9]).all(axis=1).any():
            continue
        placed = tuple(("cup", (x, y, z)) for x, y, z in places.tolist())
        drive = {"name": "clusters", "objects": 0, "placed": placed, **noise}
        clean = make(DriveSettings.model_validate({**drive, "appearance": None}), seed, pixels)
        _, directions = clean.rays.in_map(clean.keyframes.map_T_camera)
        mine = [directions[clean.whose == i] for i in range(len(placed))]
        if all(len(d) >= 20 and widest_angle(d) >= np.radians(60) for d in mine):
            return DriveSettings.model_validate(drive)


def clusters_found(scene: Scene, odometry: PoseNoise | None) -> tuple[float, float, float]:
    """The F1 of objects within 0.25 m, the F1 of pairs of observations, and the CPU time in s."""
    _, truth = np.unique(
        np.where(scene.whose < 0, len(scene.points) + np.arange(len(scene.whose)), scene.whose), return_inverse=True
    )
    begin = time.process_time()
    if odometry is None:
        association = solve(scene)
        seconds = time.process_time() - begin
        right, false, _, _ = score(scene, association, 0.25)
        owner = association.object
    else:
        result = pipeline.run(hidden(scene), Settings.model_validate({"mode": "joint", "odometry": STEP_DRIFT}), Ledger())
        seconds = time.process_time() - begin
        assert scene.log.truth is not None
        found = evaluate(result.map, scene.log.truth, result.path_after, align="se2", radius=0.25).objects
        right, false, owner = len(found.matches), len(found.false), result.association.object
        assert np.array_equal(result.rays.box, scene.rays.box)  # the same rays in the same order
    return 2 * right / max(right + false + len(scene.points), 1), pair_f1(owner, truth), seconds


def hidden(scene: Scene) -> Log:
    """The log of a scene without the ids of the objects, and with vectors only if its rays have them."""
    detections = scene.log.cameras[0].detections
    assert detections is not None
    features = None if scene.rays.feature is None else detections.features
    detections = replace(detections, track_ids=np.full(len(detections), -1), features=features)
    return replace(scene.log, cameras=(replace(scene.log.cameras[0], detections=detections),))


def pair_f1(found: Ints, truth: Ints) -> float:
    """Return the F1 of pairs of observations (R,). -1 in `found` means no landmark."""
    held = found >= 0
    table = np.zeros((found.max(initial=-1) + 1, truth.max() + 1))
    np.add.at(table, (found[held], truth[held]), 1)
    right, ours, theirs = (float((n * (n - 1) / 2).sum()) for n in (table, table.sum(axis=1), np.bincount(truth)))
    return 2 * right / max(ours + theirs, 1.0)


def path_off(map_T_base: Floats, other: Floats) -> float:
    """Return the root mean square distance (m) of two paths (K, 4, 4) after an SE(2) alignment."""
    pose, _ = align(map_T_base[:, :3, 3], other[:, :3, 3], "se2")
    moved = map_T_base[:, :3, 3] @ pose[:3, :3].T + pose[:3, 3]
    return float(np.sqrt(((moved - other[:, :3, 3]) ** 2).sum(axis=1).mean()))


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--picture", type=Path, help="write a PNG of the map of the first drive of `drift`")
    arguments = parser.parse_args()
    seeds = arguments.seeds
    if "scenes" in arguments.parts:
        print(f"{'scene':42s} {'precision':>9s} {'recall':>7s} {'RMSE m':>8s} all right")
        quality("rooms: 15 objects of 3 classes", preset("rooms"), 3.0, seeds, 0.5)
        quality("hard: 24 of 3, two moving", preset("hard"), 5.0, seeds, 0.5)
        quality("hard, noise taken to be 3 px", preset("hard"), 3.0, seeds, 0.5)
        for distance in (0.25, 0.5):
            quality(f"pair {distance} m", pair(distance, pixel_sigma=3.0), 3.0, seeds, 0.1)
            strays = pair(distance, pixel_sigma=3.0, missed=0.2, false=0.2)
            quality(f"pair {distance} m, 20 % missed and false", strays, 3.0, seeds, 0.1)
    if "speed" in arguments.parts:
        for frames in (3_500, 33_500):
            speed(frames)
    if "drift" in arguments.parts:
        drift(seeds, arguments.picture)
    if "unnamed" in arguments.parts:
        unnamed()
    if "street" in arguments.parts:
        street(seeds)
    if "appearance" in arguments.parts:
        appearance(seeds)


if __name__ == "__main__":
    main()
