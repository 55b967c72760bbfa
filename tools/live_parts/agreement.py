"""The same answer: the map of a session against offline `run --mode joint` on the same data."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from live_parts.common import ONLY_ODOMETRY, compare, replayed, settings_for
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate
from objslam.sources import SourceOptions, read

LABELS = {**ONLY_ODOMETRY, "objects": 12, "classes": 12, "false": 0.0}
DRIVES = (
    *(("demo, localised", "demo", {}, seed) for seed in range(3)),
    *(("demo, odometry", "demo", ONLY_ODOMETRY, seed) for seed in range(3)),
    *(("demo, odometry, own labels", "demo", LABELS, seed) for seed in range(2)),
    *(("drift", "drift", {}, seed) for seed in range(2)),
)


def same() -> None:
    """Compare the maps of sessions with offline maps."""
    print("the same answer: live against offline joint; objects of both, of one alone, RMSE of those of both")
    print(
        f"{'drive':<28}{'both':>6}{'live':>6}{'offline':>9}{'RMSE m':>9}{'aligned':>9}{'before the end':>18}{'live s':>8}"
        f"{'offline s':>11}"
    )
    simulated = settings_for("rays.pixel_sigma=2")
    jobs = [(f"{what} {seed}", simulate(preset(name, **changes), seed), simulated) for what, name, changes, seed in DRIVES]
    folder = os.environ.get("OBJSLAM_DATA")
    if folder and (Path(folder) / "mrclam_ds6").is_dir():
        for robot in (1, 3, 5):
            for with_range in (True, False):
                options = SourceOptions(robot=robot, with_range=with_range)
                log = read(Path(folder) / "mrclam_ds6", Ledger(), options)
                jobs.append((f"MRCLAM {robot} {'with range' if with_range else 'bearings'}", log, settings_for()))
    else:
        print("SKIPPED MRCLAM: OBJSLAM_DATA names no folder with mrclam_ds6", file=sys.stderr)
    for name, log, settings in jobs:
        begin = time.perf_counter()
        session = replayed(log, settings)
        last = session.snapshot().map
        live = session.stop()
        between = time.perf_counter()
        reference = pipeline.run(log, settings, Ledger())
        end = time.perf_counter()
        both, mine, theirs, rmse, aligned = compare(live.map, reference.map)
        also, more, fewer, error, _ = compare(last, reference.map)
        before = f"{also} +{more} -{fewer} {error:.3f}"
        print(
            f"{name:<28}{both:6d}{mine:6d}{theirs:9d}{rmse:9.3f}{aligned:9.3f}{before:>18}{between - begin:8.1f}"
            f"{end - between:11.1f}",
            flush=True,
        )
