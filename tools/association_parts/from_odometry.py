"""Drives whose poses and objects are estimated together, without the names of the landmarks."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
from log_parts import without_names
from peers.drives import drives

from association_parts.pairs import pair_f1
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align
from objslam.core.result import RunResult
from objslam.evaluation.alignment import lay_truth
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.output.plot.map_plot import draw_map
from objslam.simulation import preset, simulate

UNNAMED = ("lost in the woods", "Victoria Park")
"""The drives of the part `unnamed`."""
STEP_DRIFT = {
    **{"x_per_m": 0.0, "y_per_m": 0.0, "xy_per_rad": 0.0, "yaw_per_m": 0.0, "yaw_per_rad": 0.0},
    **{"floor_xy": 0.01, "floor_yaw": float(np.radians(0.3))},
}
"""The odometry noise of one step in the preset `drift`."""


def drift(seeds: int, picture: Path | None) -> None:
    """Map drives from odometry alone. Print F1, and the path's error as a share of that of dead reckoning."""
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
    """Print how well a run without names finds the landmarks again, and how far its path is from that of a run with names.

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
        found, truth = objects_of_rays(result, named), named.rays.label
        images = set(map(tuple, images_of(result).tolist()))
        both = [tuple(image) in images for image in images_of(named).tolist()]
        off = path_off(result.map_T_base, named.map_T_base[both])
        dead = named.keyframes.odom_T_base
        assert dead is not None
        print(
            f"{name:<20}{len(result.map.resolved()):>10}{len(np.unique(truth)):>5}{pair_f1(found, truth):>12.3f}"
            f"{off:>12.3f}{path_off(dead, named.map_T_base):>18.3f}{seconds:>7.1f}",
            flush=True,
        )


def images_of(result: RunResult) -> Floats:
    """Return the stamp of each keyframe as given, s, and the number of its camera, (K, 2)."""
    return np.column_stack([result.keyframes.frame_stamps, result.keyframes.camera])


def objects_of_rays(result: RunResult, named: RunResult) -> Ints:
    """Return the object (R,) in a result of each ray of another result, -1 for none.

    A ray that the result lacks has no object. Without names, a box inside another one is dropped as a part of its thing.
    """
    mine, its = (np.column_stack([images_of(one)[one.rays.keyframe], one.rays.box]) for one in (result, named))
    _, number = np.unique(np.concatenate([mine, its]), axis=0, return_inverse=True)
    number = number.ravel()
    objects = np.full(number.max() + 1, -1)
    objects[number[: len(mine)]] = result.association.object
    return objects[number[len(mine) :]]


def path_off(map_T_base: Floats, other: Floats) -> float:
    """Return the root mean square distance (m) of two paths (K, 4, 4) after an SE(2) alignment."""
    pose, _ = align(map_T_base[:, :3, 3], other[:, :3, 3], "se2")
    moved = map_T_base[:, :3, 3] @ pose[:3, :3].T + pose[:3, 3]
    return float(np.sqrt(((moved - other[:, :3, 3]) ** 2).sum(axis=1).mean()))
