"""Clusters of objects of one label, with and without appearance vectors, of which a fifth confuse the object."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from association_parts.from_odometry import STEP_DRIFT
from association_parts.pairs import pair_f1
from association_parts.scenes import Scene, make, score, solve
from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import widest_angle
from objslam.core.types import Log
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import AppearanceNoise, DriveSettings, PoseNoise

CLUSTERS, EACH, APART = 5, 3, 0.35
"""The number of clusters in the part `appearance`, the objects in each, and the distance (m) between two of them."""
ROUGH = PoseNoise(xy=0.02, yaw=float(np.radians(0.6)))
"""The odometry noise of one step in the part `appearance`. It is twice the noise of the preset `drift`."""


def appearance(seeds: int) -> None:
    """Print the F1 of clusters of one label without and with appearance vectors, and the share of the missing F1 that the
    vectors gain.

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
    """Return a drive around clusters along the walls. Each object has at least 20 boxes, whose rays span at least 60
    degrees."""
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
