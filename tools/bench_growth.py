"""Measure how the time to map from odometry grows with the length of the drive, and compare with a batch solve of GTSAM.

    python tools/bench_growth.py                     # drives of 2 to 60 minutes; takes a few minutes
    python tools/bench_growth.py --minutes 2 4 8 --clock 0.2
    python tools/bench_growth.py --check             # exit code 1 if the exponent of CPU time is above 1.10

The simulated drives have a room of 12 m by 9 m, 20 objects with known names, images at 5 Hz, and odometry that drifts.
--clock delays the camera, so that predicted bearings are wrong in every turn. The batch solve is GTSAM's Levenberg-Marquardt
on the same bearings and motions in one graph. It starts from the true poses and positions, so no other start takes less
time.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import gtsam
import numpy as np
from added_errors import add_shared_errors

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Odometry, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.types import Association, Keyframes, Log, Rays
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.graph.assembly import Measurements
from objslam.graph.init_known_correspondences import initialize_known
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import make_values
from objslam.mapping import pipeline
from objslam.mapping.solution import seen_something
from objslam.simulation import preset, simulate

MINUTES = (2.0, 4.0, 8.0, 15.0, 30.0, 60.0)
HIGHEST = 1.10
"""The largest exponent of CPU time over the length of the drive that --check accepts. 1 is linear."""


@dataclass(frozen=True)
class Row:
    """CPU seconds of a drive: of the growth alone, of the whole mapping, and of the batch solve from the truth."""

    growth: float
    mapping: float
    batch: float


def drive(minutes: float, clock: float, seed: int) -> Log:
    """A drive of about ten boxes a second."""
    settings = preset(
        "demo",
        room=(12.0, 9.0),
        objects=20,
        classes=20,
        frames=round(minutes * 60 * 5),
        frame_rate=5.0,
        min_view_share=0.01,
        pixel_sigma=3.0,
        false=0.0,
        localization=None,
        odometry=Odometry(),
    )
    log = simulate(settings, seed)
    return add_shared_errors(log, {"front.clock": clock}) if clock else log


def measure(log: Log, settings: Settings) -> tuple[Row, str]:
    """The times of one drive, and a line about it."""
    ledger = Ledger()
    frames = build_keyframes(log, settings, ledger)
    keyframes, rays = seen_something(frames, build_rays(log, frames, settings, ledger))
    association = associate_by_label(rays)
    begin = time.process_time()
    initialize_known(Measurements.of(keyframes, rays, settings), association, lambda done, total: None)
    growth = time.process_time() - begin
    begin = time.process_time()
    result = pipeline.run(log, settings, Ledger())
    mapping = time.process_time() - begin
    begin = time.process_time()
    iterations = batch_from_truth(log, keyframes, rays, association, settings)
    batch = time.process_time() - begin
    found = evaluate(result.map, log.truth, result.path_after, align="se2", radius=2.0).to_dict()
    line = (
        f"{len(keyframes):9d}{len(rays):8d}{growth:9.2f}{mapping:9.2f}{batch:9.2f}{iterations:5d}{mapping / batch:8.1f}"
        f"{found['matched']:9d}{found['position_rmse']:8.3f}{found['ate']:8.3f}"
    )
    return Row(growth, mapping, batch), line


def batch_from_truth(log: Log, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings) -> int:
    """Solve the graph of a drive from the truth, and return the number of iterations."""
    truth = log.truth
    assert truth is not None
    assert truth.trajectory is not None
    base, _ = interpolate(truth.trajectory.stamps, truth.trajectory.poses, keyframes.stamps, np.inf)
    place = {one.label: one.position for one in truth.objects}
    landmarks = np.arange(association.count)
    points = np.array([place[rays.label_names[label]] for label in association.label])
    measured = Measurements.of(keyframes, rays, settings)
    graph = build_graph(measured.factors(association.object, np.flatnonzero(association.object >= 0), landmarks, points))
    values = make_values(base @ keyframes.base_T_camera, points, landmarks)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
    optimizer.optimize()
    return int(optimizer.iterations())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, nargs="+", default=MINUTES)
    parser.add_argument("--clock", type=float, default=0.0, help="the delay of the camera, s")
    parser.add_argument("--calibration", action="store_true", help="also estimate the shared errors")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--check", action="store_true", help=f"fail if the exponent of the mapping is above {HIGHEST}")
    options = parser.parse_args()
    use = str(options.calibration).lower()
    settings = load_settings(
        None, ("mode=joint", "association.method=by_label", "output.recording=false", f"calibration.use={use}")
    )
    measure(drive(0.5, 0.0, 1), settings)  # the first use imports and warms what is measured
    print(
        f"{'minutes':>8}{'keyframes':>9}{'rays':>8}{'growth s':>9}{'all s':>9}{'batch s':>9}{'its':>5}{'ratio':>8}"
        f"{'matched':>9}{'RMSE m':>8}{'ATE m':>8}"
    )
    rows = []
    for minutes in options.minutes:
        row, line = measure(drive(minutes, options.clock, options.seed), settings)
        rows.append(row)
        print(f"{minutes:8g}{line}", flush=True)
    if len(rows) < 2:
        return 0
    exponents = {
        name: float(np.polyfit(np.log(options.minutes), np.log([getattr(row, name) for row in rows]), 1)[0])
        for name in ("growth", "mapping", "batch")
    }
    print("exponents of CPU time: " + ", ".join(f"{name} {value:.2f}" for name, value in exponents.items()))
    return int(options.check and exponents["mapping"] > HIGHEST)


if __name__ == "__main__":
    sys.exit(main())
