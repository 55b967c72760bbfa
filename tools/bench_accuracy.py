"""Measure the errors of maps, and whether their sigmas are right, on simulated drives.

    python tools/bench_accuracy.py [--drives 100]

The drives are in the demo's room with 12 objects. Each class has a false box in 5 % of the images. The poses are from a
localisation (fixed) or from odometry alone (joint). The table has the share of objects whose true position is inside their
95 % ellipsoid, and the errors beside those that the covariances promise. `tools/bench_recordings.py` does this for recorded
drives.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.stats import chi2

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

RADIUS = 2.0
"""The radius of a match, m. Labels identify the objects here, and a large error must not count as a missed object."""
ELLIPSOID = float(chi2.ppf(0.95, 3))


def solved_path(result: pipeline.RunResult) -> Trajectory:
    """The path at the keyframes, after the solve."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    return Trajectory(stamps, result.map_T_base[first])


def simulated(drives: int) -> None:
    """Coverage of the ellipsoids and errors, poses fixed and joint."""
    print(f"{drives} simulated drives of 12 objects, 200 frames")
    print(
        f"{'mode':<7}{'in 95 %':>9}{'NEES/3':>8}{'objects':>9}{'missed':>8}{'false':>7}{'unresolved':>12}"
        f"{'median m':>10}{'RMSE m':>9}{'promised m':>12}{'ATE m':>8}{'s a drive':>11}"
    )
    for mode in ("fixed", "joint"):
        settings = load_settings(None, (f"mode={mode}", "rays.pixel_sigma=2"))
        drifting = {"localization": None, "odometry": Odometry()} if mode == "joint" else {}
        drive = preset("demo", objects=12, classes=12, frames=200, **drifting)
        nees, error, promised, ate, missed, false, unresolved = [], [], [], [], 0, 0, 0
        begin = time.perf_counter()
        for seed in range(drives):
            log = simulate(drive, seed)
            result = pipeline.run(log, settings, Ledger())
            found = evaluate(result.map, log.truth, solved_path(result), radius=RADIUS)
            assert found.objects is not None
            for match in found.objects.matches:
                covariance = match.object.covariance
                nees.append(match.offset @ np.linalg.solve(covariance, match.offset))
                promised.append(np.trace(covariance))
                error.append(match.error)
            missed += len(found.objects.missed)
            false += len(found.objects.false)
            unresolved += found.objects.unresolved
            ate.append(found.to_dict()["ate"])
        seconds = (time.perf_counter() - begin) / drives
        print(
            f"{mode:<7}{np.mean(np.array(nees) < ELLIPSOID):9.1%}{np.mean(nees) / 3:8.2f}{len(nees):9d}{missed:8d}{false:7d}"
            f"{unresolved:12d}{np.median(error):10.4f}{rms(error):9.4f}{np.sqrt(np.mean(promised)):12.4f}{rms(ate):8.4f}"
            f"{seconds:11.2f}",
            flush=True,
        )


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=100)
    simulated(parser.parse_args().drives)


if __name__ == "__main__":
    main()
