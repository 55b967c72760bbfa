"""Map recorded drives with default settings, and compare each map with its truth and with its own sigmas.

    python tools/bench_recordings.py [--parts named robots short poses late cube ycbv classes unnamed] [--only 6-1]
        [--set KEY=VALUE]

named: UTIAS MRCLAM 6 and 7 (15 landmarks, the odometry of wheels) and Lost in the Woods (17 posts, one observation a
second), each landmark with a label of its own, from bearings and with ranges. robots: the MRCLAM drives, with the boxes of
the other robots, which drive around, each with a label of its own. Their objects are false. short: parts of the MRCLAM
drives of two to five minutes. poses: whole drives at the poses of the motion capture. late: drives whose motion capture
begins after two fifths of the time, beside the odometry, with mode fixed and auto. cube: a cabinet of TUM fr3 at the poses
of the motion capture. ycbv: five objects that DOPE found, at the cameras' true poses. classes, unnamed: the named drives
with ranges, and eight labels for all landmarks, or one.

Maps from odometry are compared after SE(2) alignment. The truth is inside a 95 % ellipsoid in 95 % of the cases, if the
covariances are right. Times are of the processor, for the map alone.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "real"))
from log_parts import part, with_classes
from lost_in_the_woods import read_lost_in_the_woods
from other_robots import read_with_other_robots
from ycbv import RUNS, read_ycbv

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import ObjslamError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read

RADIUS = 2.0
"""The radius of a match, m, of landmarks whose labels identify them. A large error must not count as a missed landmark."""
UNNAMED_RADIUS = 0.5
"""The radius of a match, m, where landmarks share labels. The landmarks are 0.1 m and more apart."""
DRIVES = (("mrclam_ds6", (1, 3, 5)), ("mrclam_ds7", (1, 3)))
PARTS = ((0, 300), (300, 600), (600, 900), (200, 320), (800, 1000))
"""The begins and ends, s, of the parts of a drive."""
LATE = 0.4
"""The share of a drive after which the motion capture begins."""
CABINET = np.array([-1.522, 0.457, 0.282])
"""The cabinet's centre, m, in the depth images, fused with the true poses: from the floor, at 0, to its top, at 0.563 m."""
CABINET_SIZE = np.array([0.826, 0.498, 0.563])
"""The length, width and height, m, of the cabinet in the same surface."""


def drives(data: Path, only: str, with_range: bool, other_robots: bool = False) -> Iterator[tuple[str, Log]]:
    """Read the drives whose name contains `only`: 6-1, ..., 7-3, woods. other_robots: without woods, and with the boxes
    of the other robots."""
    for folder, robots in DRIVES:
        for robot in robots:
            name = f"{folder[-1]}-{robot}"
            if only in name and other_robots:
                yield name, read_with_other_robots(data / folder, robot, with_range=with_range)
            elif only in name:
                yield name, read(data / folder, Ledger(), SourceOptions(robot=robot, with_range=with_range))
    if only in "woods" and not other_robots:
        yield "woods", read_lost_in_the_woods(data / "lost_in_the_woods", with_range=with_range)


def solve(log: Log, overrides: list[str]) -> tuple[RunResult, float]:
    """Return the result in joint mode, and the seconds of the processor."""
    begin = time.process_time()
    settings = load_settings(None, ("mode=joint", "output.recording=false", *overrides))
    return pipeline.run(log, settings, Ledger()), time.process_time() - begin


def judged(log: Log, result: RunResult, radius: float = RADIUS, align: str = "se2") -> dict:
    """Compare the map and the path with the truth."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    return evaluate(result.map, log.truth, path, align=align, radius=radius).to_dict()


def compare(data: Path, only: str, overrides: list[str], classes: int = 0, other_robots: bool = False) -> None:
    """Print a line for each drive. classes: the number of labels of all landmarks, 0 if each has its own."""
    labels = (
        f"{classes} label{'s' if classes > 1 else ''} for all landmarks" if classes else "each landmark with its own label"
    )
    print(
        f"whole drives{' with ranges' if classes else ''}, {labels}{', and boxes of other robots' if other_robots else ''}"
    )
    print(
        f"{'drive':<7}{'range':>6}{'right':>7}{'false':>7}{'missed':>8}{'RMSE m':>8}{'without scale':>15}{'inside 95 %':>13}"
        f"{'median Mahalanobis^2':>22}{'ATE m':>8}{'s':>7}"
    )
    for with_range in (True,) if classes else (False, True):
        for name, log in drives(data, only, with_range, other_robots):
            log = with_classes(log, classes) if classes else log
            result, seconds = solve(log, overrides)
            found = judged(log, result, UNNAMED_RADIUS if classes else RADIUS)
            scaled = judged(log, result, UNNAMED_RADIUS if classes else RADIUS, "sim2")
            inside = f"{round(found['inside_95_3d'] * found['matched'])} of {found['matched']}"
            print(
                f"{name:<7}{'yes' if with_range else 'no':>6}{found['matched']:7d}{found['false']:7d}{found['missed']:8d}"
                f"{found['position_rmse']:8.3f}{scaled['position_rmse']:15.3f}{inside:>13}{found['mahalanobis_median']:22.2f}"
                f"{found['ate']:8.3f}{seconds:7.1f}",
                flush=True,
            )


def short(data: Path, only: str, overrides: list[str]) -> None:
    """Landmarks of parts of the MRCLAM drives, without and with range."""
    print("parts of UTIAS MRCLAM 6 and 7, each landmark with its own label")
    print(
        f"{'range':>6}{'parts':>7}{'landmarks':>11}{'inside 95 %':>13}{'median Mahalanobis^2':>22}{'RMSE m':>8}"
        f"{'s a part':>10}"
    )
    for with_range in (False, True):
        inside, squared, errors, times = 0, [], [], []
        for name, whole in drives(data, only, with_range):
            for begin, end in PARTS if name != "woods" else ():
                try:
                    log = part(whole, begin, end)
                    result, seconds = solve(log, overrides)
                except ObjslamError as error:  # One robot saw no landmark in one part.
                    print(f"{name}, {begin} to {end} s: {error}", file=sys.stderr)
                    continue
                found = judged(log, result)
                inside += round(found["inside_95_3d"] * found["matched"])
                squared.append(found["mahalanobis_median"])
                errors += [one["error"] for one in found["objects"]]
                times.append(seconds)
        if errors:
            print(
                f"{'yes' if with_range else 'no':>6}{len(squared):7d}{len(errors):11d}{inside / len(errors):13.1%}"
                f"{np.median(squared):22.2f}{np.sqrt(np.mean(np.square(errors))):8.3f}{np.mean(times):10.1f}",
                flush=True,
            )


def poses(data: Path, only: str, overrides: list[str]) -> None:
    """Landmarks of whole drives at the poses of the motion capture, without an alignment: fixed, and joint with odometry."""
    print("whole drives at the poses of the motion capture")
    print(
        f"{'drive':<7}{'mode':>6}{'range':>7}{'right':>7}{'false':>7}{'missed':>8}{'RMSE m':>8}{'inside 95 %':>13}"
        f"{'median Mahalanobis^2':>22}{'s':>7}"
    )
    for mode, ranged in (("fixed", False), ("fixed", True), ("joint", False), ("joint", True)):
        for name, log in drives(data, only, ranged):
            assert log.truth is not None
            odometry = log.odometry if mode == "joint" else None
            localized = replace(log, localization=log.truth.trajectory, odometry=odometry)
            result, seconds = solve(localized, [f"mode={mode}", *overrides])
            found = judged(log, result, align="none")
            inside = f"{round(found['inside_95_3d'] * found['matched'])} of {found['matched']}"
            print(
                f"{name:<7}{mode:>6}{'yes' if ranged else 'no':>7}{found['matched']:7d}{found['false']:7d}"
                f"{found['missed']:8d}{found['position_rmse']:8.3f}{inside:>13}{found['mahalanobis_median']:22.2f}{seconds:7.1f}",
                flush=True,
            )


def late(data: Path, only: str, overrides: list[str]) -> None:
    """Landmarks of drives from bearings, with the odometry of the whole drive and the motion capture from `LATE` on."""
    print("the motion capture begins late, and the odometry does not")
    print(
        f"{'drive':<7}{'mode':>6}{'right':>7}{'false':>7}{'missed':>8}{'RMSE m':>8}{'inside 95 %':>13}{'keyframes':>11}"
        f"{'s':>7}"
    )
    for name, log in drives(data, only, with_range=False):
        assert log.truth is not None
        path = log.truth.trajectory
        kept = path.stamps >= path.stamps[0] + LATE * np.ptp(path.stamps)
        localized = replace(log, localization=Trajectory(path.stamps[kept], path.poses[kept]))
        for mode in ("fixed", "auto"):
            result, seconds = solve(localized, [f"mode={mode}", *overrides])
            found = judged(log, result, align="none")
            inside = f"{round(found['inside_95_3d'] * found['matched'])} of {found['matched']}"
            print(
                f"{name:<7}{mode:>6}{found['matched']:7d}{found['false']:7d}{found['missed']:8d}{found['position_rmse']:8.3f}"
                f"{inside:>13}{len(result.keyframes):11d}{seconds:7.1f}",
                flush=True,
            )


def cube(data: Path, overrides: list[str]) -> None:
    """The cabinet against the fused surface, poses fixed, with depths and without."""
    print("TUM fr3_cabinet (cube_slam), fixed")
    print(
        f"{'depth':>6}{'horizontally m':>16}{'in height m':>13}{'Mahalanobis^2 (95 %: 7.81)':>28}{'size, error in %':>20}"
        f"{'rays':>6}{'s':>7}"
    )
    for use in ("true", "false"):
        log = read(data / "cube_slam", Ledger(), SourceOptions(label="cabinet"))
        result, seconds = solve(log, ["mode=fixed", f"depth.use={use}", *overrides])
        for cabinet in result.map.resolved():
            off = cabinet.position - CABINET
            squared = off @ np.linalg.solve(cabinet.covariance, off)
            size = "none" if cabinet.body is None else " ".join(f"{x:+.0%}" for x in cabinet.body.size / CABINET_SIZE - 1)
            yes = "yes" if use == "true" else "no"
            print(
                f"{yes:>6}{np.linalg.norm(off[:2]):16.4f}{off[2]:+13.3f}{squared:28.2f}{size:>20}{cabinet.rays:6d}{seconds:7.1f}"
            )


def ycbv(data: Path, overrides: list[str]) -> None:
    """The error of one object a run, against its covariance, poses fixed."""
    print("DOPE on YCB-Video, fixed")
    print(f"{'run':<24}{'error m':>9}{'sigma m':>9}{'Mahalanobis^2 (95 %: 7.81)':>28}{'s':>7}")
    for name, run in RUNS:
        log = read_ycbv(data / "ycbv_dope", name, run)
        result, seconds = solve(log, ["mode=fixed", *overrides])
        assert log.truth is not None
        for one in result.map.resolved():
            off = one.position - log.truth.objects[0].position
            squared = off @ np.linalg.solve(one.covariance, off)
            sigma = np.sqrt(np.trace(one.covariance))
            print(f"{name + ' ' + run:<24}{np.linalg.norm(off):9.4f}{sigma:9.4f}{squared:28.2f}{seconds:7.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("named", "robots", "short", "poses", "late", "cube", "ycbv", "classes", "unnamed")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--only", default="", help="only the drives whose name contains this, such as 6-1 or woods")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of all runs")
    arguments = parser.parse_args()
    folder = os.environ.get("OBJSLAM_DATA")
    if folder is None or not Path(folder).is_dir():
        sys.exit("OBJSLAM_DATA names no folder with the recordings")
    data, only, overrides = Path(folder), arguments.only, arguments.set
    work = {
        "named": lambda: compare(data, only, overrides),
        "short": lambda: short(data, only, overrides),
        "poses": lambda: poses(data, only, overrides),
        "late": lambda: late(data, only, overrides),
        "cube": lambda: cube(data, overrides),
        "ycbv": lambda: ycbv(data, overrides),
        "robots": lambda: compare(data, only, overrides, other_robots=True),
        "classes": lambda: compare(data, only, overrides, classes=8),
        "unnamed": lambda: compare(data, only, overrides, classes=1),
    }
    for name in arguments.parts:
        work[name]()


if __name__ == "__main__":
    main()
