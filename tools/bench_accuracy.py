"""Measure the errors of maps, and whether their sigmas are right, on simulated drives and on recordings.

    python tools/bench_accuracy.py [--drives 100] [--parts simulated mrclam short cube]

simulated: drives in the demo's room with 12 objects. Each class has a false box in 5 % of the images. The poses are from a
localisation (fixed) or from odometry alone (joint). The table has the share of objects whose true position is inside their
95 % ellipsoid, and the errors beside those that the covariances promise. mrclam, cube: the recordings UTIAS MRCLAM 6 and
TUM fr3_cabinet, from the folder in OBJSLAM_DATA. short: parts of MRCLAM 6 and 7, of two to five minutes, and the share of
landmarks whose true place is inside their 95 % ellipsoid.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from log_parts import part
from scipy.stats import chi2

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.types import Trajectory
from objslam.errors import ObjslamError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate
from objslam.sources import SourceOptions, read

RADIUS = 2.0
"""The radius of a match, m. Labels identify the objects here, and a large error must not count as a missed object."""
ELLIPSOID = float(chi2.ppf(0.95, 3))
PARTS = ((0, 300), (300, 600), (600, 900), (200, 320), (800, 1000))
"""The begins and ends, s, of the parts of a drive."""
CABINET = np.array([-1.520, 0.454])
"""The x and y, m, of the cabinet's centre in the depth images, fused with the true poses."""


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


def mrclam(data: Path) -> None:
    """Landmarks and path of the three robots, joint, without and with range."""
    print("UTIAS MRCLAM 6, joint, after SE(2) alignment")
    print(
        f"{'robot':>5}{'range':>7}{'landmarks':>11}{'RMSE m':>9}{'max m':>8}{'scale':>8}{'ATE m':>8}"
        f"{'odometry m':>12}{'keyframes':>11}{'rays':>7}{'rejected':>10}{'s':>7}"
    )
    for robot in (1, 3, 5):
        for with_range in (False, True):
            log = read(data, Ledger(), SourceOptions(robot=robot, with_range=with_range))
            begin = time.perf_counter()
            result = pipeline.run(log, load_settings(None, ("mode=joint",)), Ledger())
            seconds = time.perf_counter() - begin
            path, counts = solved_path(result), result.summary["counts"]
            found = evaluate(result.map, log.truth, path, align="se2", radius=RADIUS).to_dict()
            before = evaluate(ObjectMap(()), log.truth, log.odometry, align="se2").to_dict()
            scaled = evaluate(result.map, log.truth, path, align="sim2", radius=RADIUS).objects
            assert scaled is not None
            print(
                f"{robot:5d}{'yes' if with_range else 'no':>7}{found['matched']:11d}{found['position_rmse']:9.3f}"
                f"{found['position_max']:8.3f}{1 / scaled.transform.scale:8.3f}{found['ate']:8.3f}{before['ate']:12.2f}"
                f"{counts['keyframes']:11d}{counts['rays']:7d}{counts['rays_rejected']:10d}{seconds:7.1f}",
                flush=True,
            )


def short(data: Path) -> None:
    """Landmarks of parts of the recorded drives, without and with range, against their own covariances."""
    print("Parts of UTIAS MRCLAM 6 and 7, joint, after SE(2) alignment")
    print(f"{'range':>6}{'parts':>7}{'landmarks':>11}{'in 95 %':>9}{'median squared Mahalanobis':>28}{'RMSE m':>8}")
    for with_range in (False, True):
        inside, squared, errors = 0, [], []
        for folder, robots in (("mrclam_ds6", (1, 3, 5)), ("mrclam_ds7", (1, 3))):
            for robot in robots:
                whole = read(data / folder, Ledger(), SourceOptions(robot=robot, with_range=with_range))
                for begin, end in PARTS:
                    try:
                        log = part(whole, begin, end)
                        result = pipeline.run(log, load_settings(None, ("mode=joint",)), Ledger())
                    except ObjslamError as error:  # One robot saw no landmark in one part.
                        print(f"{folder} robot {robot}, {begin} to {end} s: {error}", file=sys.stderr)
                        continue
                    found = evaluate(result.map, log.truth, align="se2", radius=RADIUS).to_dict()
                    inside += round(found["inside_95_3d"] * found["matched"])
                    squared.append(found["mahalanobis_median"])
                    errors += [one["error"] for one in found["objects"]]
        print(
            f"{'yes' if with_range else 'no':>6}{len(squared):7d}{len(errors):11d}{inside / len(errors):9.1%}"
            f"{np.median(squared):28.2f}{rms(errors):8.3f}",
            flush=True,
        )


def cube(data: Path) -> None:
    """The cabinet's horizontal error, poses fixed, with depths and without."""
    print("TUM fr3_cabinet (cube_slam), fixed")
    print(f"{'depth':>6}{'horizontally m':>16}{'height m':>10}{'rays':>6}{'rms deg':>9}{'s':>7}")
    for use in ("true", "false"):
        log = read(data, Ledger(), SourceOptions(label="cabinet"))
        begin = time.perf_counter()
        result = pipeline.run(log, load_settings(None, (f"depth.use={use}",)), Ledger())
        seconds = time.perf_counter() - begin
        for cabinet in result.map.resolved():
            off = np.linalg.norm(cabinet.position[:2] - CABINET)
            yes = "yes" if use == "true" else "no"
            print(f"{yes:>6}{off:16.4f}{cabinet.position[2]:10.3f}{cabinet.rays:6d}{cabinet.rms_deg:9.2f}{seconds:7.1f}")


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=100)
    parts = ("simulated", "mrclam", "short", "cube")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    arguments = parser.parse_args()
    if "simulated" in arguments.parts:
        simulated(arguments.drives)
    folder = os.environ.get("OBJSLAM_DATA")
    for chosen, name, work in (("mrclam", "mrclam_ds6", mrclam), ("short", ".", short), ("cube", "cube_slam", cube)):
        if chosen not in arguments.parts:
            continue
        if folder is None or not (Path(folder) / name).is_dir():
            where = f"no {name} in {folder}" if folder else "OBJSLAM_DATA names no folder"
            print(f"SKIPPED {chosen}: {where}", file=sys.stderr)
            continue
        work(Path(folder) / name)


if __name__ == "__main__":
    main()
