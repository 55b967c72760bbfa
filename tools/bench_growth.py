"""Measure how the time to map from odometry grows with the length of the drive, and compare with a batch solve of GTSAM.

    python tools/bench_growth.py                     # drives of 2 to 60 minutes; takes a few minutes
    python tools/bench_growth.py --minutes 2 4 8 --clock 0.2
    python tools/bench_growth.py --unnamed           # one label for all objects
    python tools/bench_growth.py --check             # exit code 1 if the exponent of CPU time is above 1.10, 1.25 unnamed

The simulated drives have a room of 12 m by 9 m, 20 objects, images at 5 Hz, and odometry that drifts.
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
from log_parts import without_names

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
from objslam.graph.init_unknown_correspondences import initialize_unknown
from objslam.graph.optimizers import build_graph
from objslam.graph.variables import make_values
from objslam.mapping import pipeline
from objslam.mapping.solution import seen_something
from objslam.simulation import preset, simulate

MINUTES = (2.0, 4.0, 8.0, 15.0, 30.0, 60.0)
HIGHEST, HIGHEST_UNNAMED = 1.10, 1.25
"""The largest exponents of CPU time over the length of a drive that --check accepts, with names and without. 1 is linear."""
RADIUS, RADIUS_UNNAMED = 2.0, 0.5
"""The radius of a match, m, with labels and without. Labels identify objects, so a large error is no missed object."""


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


def seen(log: Log, settings: Settings) -> tuple[Keyframes, Rays]:
    """The keyframes of a log that have a ray, and the rays."""
    frames = build_keyframes(log, settings, Ledger())
    return seen_something(frames, build_rays(log, frames, settings, Ledger()))


def measure(named: Log, settings: Settings, unnamed: bool) -> tuple[Row, str]:
    """The times of one drive, and a line about it. The batch solve always has the names."""
    log = without_names(named) if unnamed else named
    keyframes, rays = seen(named, settings)
    association = associate_by_label(rays)
    known, explored = Measurements.of(keyframes, rays, settings), seen(log, settings)
    begin = time.process_time()
    if unnamed:
        initialize_unknown(*explored, tuple(c.camera for c in log.cameras), settings, lambda done, total: None)
    else:
        initialize_known(known, association, lambda done, total: None)
    growth = time.process_time() - begin
    begin = time.process_time()
    result = pipeline.run(log, settings, Ledger())
    mapping = time.process_time() - begin
    begin = time.process_time()
    iterations = batch_from_truth(named, keyframes, rays, association, settings)
    batch = time.process_time() - begin
    radius = RADIUS_UNNAMED if unnamed else RADIUS
    found = evaluate(result.map, log.truth, result.path_after, align="se2", radius=radius).to_dict()
    line = (
        f"{len(keyframes):9d}{len(rays):8d}{growth:9.2f}{mapping:9.2f}{batch:9.2f}{iterations:5d}{mapping / batch:8.1f}"
        f"{found['matched']:9d}{found['false']:7d}{found['position_rmse']:8.3f}{found['ate']:8.3f}"
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
    parser.add_argument("--unnamed", action="store_true", help="one label for all objects")
    parser.add_argument("--check", action="store_true", help="fail if the exponent of the mapping is too large")
    options = parser.parse_args()
    method, highest = ("auto", HIGHEST_UNNAMED) if options.unnamed else ("by_label", HIGHEST)
    use = str(options.calibration).lower()
    settings = load_settings(
        None, ("mode=joint", f"association.method={method}", "output.recording=false", f"calibration.use={use}")
    )
    measure(drive(0.5, 0.0, 1), settings, unnamed=False)  # the first use imports and warms what is measured
    print(
        f"{'minutes':>8}{'keyframes':>9}{'rays':>8}{'growth s':>9}{'all s':>9}{'batch s':>9}{'its':>5}{'ratio':>8}"
        f"{'matched':>9}{'false':>7}{'RMSE m':>8}{'ATE m':>8}"
    )
    rows = []
    for minutes in options.minutes:
        row, line = measure(drive(minutes, options.clock, options.seed), settings, options.unnamed)
        rows.append(row)
        print(f"{minutes:8g}{line}", flush=True)
    if len(rows) < 2:
        return 0
    exponents = {
        name: float(np.polyfit(np.log(options.minutes), np.log([getattr(row, name) for row in rows]), 1)[0])
        for name in ("growth", "mapping", "batch")
    }
    print("exponents of CPU time: " + ", ".join(f"{name} {value:.2f}" for name, value in exponents.items()))
    return int(options.check and exponents["mapping"] > highest)


if __name__ == "__main__":
    sys.exit(main())
