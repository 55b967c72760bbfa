"""Measure whether the sigmas of square fiducials hold the truth, on simulated drives past eight tags.

    python tools/bench_tags.py [--noise 0.3 0.5] [--reach 1.6] [--unknown] [--wrong 0.01] [--defaults] [--mode M]

The odometry has the noise of the settings. A line for each noise of the corners (px) says which share of the positions, the
rotations and, with --unknown, the sizes has the truth inside its 95 % region. It also gives the median error of each, the
share of tags with a second rotation, and the CPU time.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from graph.tag_drives import TagDrive, make_tag_drive

from objslam.config import load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import exp_se3
from objslam.mapping import pipeline

REGION_3, REGION_1 = 7.815, 3.841
"""The squared Mahalanobis distances of the border of the 95 % region, with 3 degrees of freedom and with 1."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=25, help="drives for each noise")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.3, 0.5], help="standard deviation of a corner, px")
    parser.add_argument("--reach", type=float, default=1.6, help="least distance of a tag, m; the largest is 1.5 m more")
    parser.add_argument("--unknown", action="store_true", help="the sizes are not told")
    parser.add_argument("--wrong", type=float, default=0.0, help="standard deviation of an error that all given sizes share")
    parser.add_argument("--defaults", action="store_true", help="the noise is not told, and shared errors are estimated")
    parser.add_argument("--mode", choices=("joint", "fixed"), default="joint")
    options = parser.parse_args()
    for noise in options.noise:
        begin = time.process_time()
        drives = [make_tag_drive(seed, pixel_sigma=noise, reach=options.reach) for seed in range(options.seeds)]
        rows = np.concatenate([measured(drive, seed, noise, options) for seed, drive in enumerate(drives)])
        report(noise, rows, sum(len(drive.map_T_tag) for drive in drives), time.process_time() - begin)


def measured(drive: TagDrive, seed: int, noise: float, options: argparse.Namespace) -> Floats:
    """Return for each tag that was found: the squared Mahalanobis distances of position, rotation and size, their errors (m,
    rad, share), and whether there is a second rotation."""
    log = drive.log
    if options.mode == "fixed":
        assert log.odometry is not None
        rng, off = np.random.default_rng(seed), np.zeros((len(log.odometry), 6))
        off[:, 2], off[:, 3:5] = 0.005 * rng.normal(size=len(off)), 0.02 * rng.normal(size=(len(off), 2))
        log = replace(log, odometry=None, localization=replace(log.odometry, poses=drive.map_T_base @ exp_se3(off)))
    plain = ("output.recording=false", "checks.use=false", "association.method=by_label", f"mode={options.mode}")
    told = ("calibration.use=false", "noise.rays=false", "noise.odometry=false", f"tags.corner_sigma={noise}")
    settings = load_settings(None, (*plain, *(() if options.defaults else told)))
    ratio = np.exp(options.wrong * np.random.default_rng([seed, 1]).normal())
    sizes = {} if options.unknown else {label: side * ratio for label, side in drive.side.items()}
    settings = settings.model_copy(update={"tags": settings.tags.model_copy(update={"sizes": sizes})})
    rows = []
    for o in pipeline.run(log, settings, Ledger()).map.resolved():
        assert o.tag is not None
        true = drive.map_T_tag[o.label]
        off = o.position - true[:3, 3]
        turns = [o.tag.rotation] if o.tag.other is None else [o.tag.rotation, o.tag.other]
        vectors = [Rotation.from_matrix(r.T @ true[:3, :3]).as_rotvec() for r in turns]
        size = np.log(o.tag.size / drive.side[o.label])
        rows.append(
            (
                off @ np.linalg.solve(o.covariance, off),
                min(v @ np.linalg.solve(o.tag.covariance, v) for v in vectors),
                (size * o.tag.size / o.tag.size_sigma) ** 2 if options.unknown else 0.0,
                np.linalg.norm(off),
                np.linalg.norm(vectors[0]),
                abs(size),
                o.tag.other is not None,
            )
        )
    return np.array(rows).reshape(-1, 7)


def report(noise: float, rows: Floats, tags: int, seconds: float) -> None:
    place, turn, size = (rows[:, :3] <= [REGION_3, REGION_3, REGION_1]).mean(axis=0)
    away, angle, share = np.median(rows[:, 3:6], axis=0)
    print(
        f"{noise} px: {len(rows)} of {tags} tags, inside 95 %: positions {place:.1%}, rotations {turn:.1%}, sizes {size:.1%}"
    )
    print(
        f"  median error {away:.3f} m, {np.degrees(angle):.1f} deg, {share:.1%}, second rotation {rows[:, 6].mean():.0%}, "
        f"{seconds:.0f} s of CPU"
    )
    print(f"  squared deviations, median: {np.median(rows[:, :3], axis=0).round(2).tolist()} (honest 2.37, 2.37, 0.45)")


if __name__ == "__main__":
    main()
