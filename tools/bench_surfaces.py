"""Depths that end on the surfaces of things: errors of centres, of the map's scale, and whether the sigmas hold them.

    python tools/bench_surfaces.py [--drives 8] [--first 0] [--ends surface centre none] [--modes joint fixed] [--wide 1]

Drives inside a ring of boxes seen at any angle, cylinders, balls, ellipsoids and flat signs of 0.15 to 1 m. The depth of a
box is read from a depth image of the thing and of a wall behind it (`surface`), or is that of the centre (`centre`). Joint
mode runs from odometry alone, whose scale is wrong by 1.5 % (one sigma). Each thing has a label of its own. Settings are
the defaults. --wide: a factor on the sizes of things.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mapping.surface_drives import surface_drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first drive")
    parser.add_argument("--ends", nargs="+", default=["surface", "centre", "none"])
    parser.add_argument("--modes", nargs="+", default=["joint", "fixed"])
    parser.add_argument("--wide", type=float, default=1.0)
    parser.add_argument("--around", action="store_true", help="drives around six things instead of inside a ring")
    parser.add_argument("--set", nargs="+", default=[], help="settings, such as bodies.use=false")
    parser.add_argument("--each", action="store_true", help="print each drive")
    options = parser.parse_args()
    for ends in options.ends:
        for mode in options.modes:
            measure(ends, mode, options)


def measure(ends: str, mode: str, options: argparse.Namespace) -> None:
    """Run the drives with one kind of depths in one mode, and print their scores together."""
    rows = []
    for seed in range(options.first, options.first + options.drives):
        log = surface_drive(seed, ends=None if ends == "none" else ends, wide=options.wide, around=options.around)
        poses = "odometry" if mode == "joint" else "localization"
        settings = load_settings(None, (f"mode={mode}", f"poses.use={poses}", "output.recording=false", *options.set))
        begin = time.process_time()
        result = pipeline.run(log, settings, Ledger())
        seconds = time.process_time() - begin
        align = "se2" if mode == "joint" else "none"
        found = evaluate(result.map, log.truth, result.path_after, align=align, radius=1.0).to_dict()
        free = evaluate(result.map, log.truth, result.path_after, align="sim2", radius=1.0)
        assert free.objects is not None
        scale = free.objects.transform.scale - 1
        inside = found["inside_95_3d"] * found["matched"]
        rows.append(
            (found["matched"], len(log.truth.objects), inside, found["position_rmse"], scale, found["iou_median"], seconds)
        )
        if options.each:
            of = result.calibration
            told = {} if of is None else dict(zip(of.names, zip(of.values, of.sigma, strict=True), strict=True))
            shown = [f"{n} {v:+.3f} ({s:.3f})" for n, (v, s) in told.items() if n in ("odometry.scale", "surface")]
            line = f"  {seed}: RMSE {found['position_rmse']:.3f} m, map {-scale:+.2%}, inside {inside:.0f}"
            print(line, *shown, flush=True)
    matched, objects, inside, rmse, scale, overlap, seconds = np.array(rows).T
    print(
        f"{ends:8}{mode:6} {matched.sum():.0f} of {objects.sum():.0f} objects, inside 95 %: "
        f"{inside.sum() / matched.sum():.1%}, RMSE median {np.median(rmse):.3f} largest {rmse.max():.3f} m, scale of the "
        f"map off by {np.sqrt((scale**2).mean()):.2%} (mean {-scale.mean():+.2%}), 3D overlap {np.median(overlap):.2f}, "
        f"{np.mean(seconds):.1f} s of CPU",
        flush=True,
    )


if __name__ == "__main__":
    main()
