"""Things that hide each other in part: what is found, errors of centres and sizes, and whether the sigmas hold them.

    python tools/bench_hiding.py [--drives 4] [--modes fixed joint] [--scenes things pillars desks] [--set bodies.use=false]

Drives of two laps among things of 0.3 to 1.5 m, with boxes around the visible parts only, and the same drives with boxes
around whole things as if nothing hid anything. In the scene `things`, the things in front have boxes too. In `pillars`,
posts and ends of walls without boxes stand in front. In `desks`, a chair with a box hides one end of each desk of 1.4 m from
most sides. Only the desks are scored there. In joint mode, each thing has a label of its own. Settings are the
defaults.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mapping.hiding_drives import desks, hiding_drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import INSIDE_95_3D, ObjectScores, evaluate
from objslam.mapping import pipeline


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--modes", nargs="+", default=["fixed", "joint"])
    parser.add_argument("--scenes", nargs="+", default=["things", "pillars", "desks"])
    parser.add_argument(
        "--hiding", type=int, nargs="+", default=[1, 0], help="1: boxes of visible parts, 0: of whole things"
    )
    parser.add_argument("--set", nargs="+", default=[], help="settings, such as bodies.use=false")
    parser.add_argument("--each", action="store_true", help="print each object")
    options = parser.parse_args()
    for scene in options.scenes:
        for mode in options.modes:
            for hiding in options.hiding:
                measure(scene, mode, bool(hiding), options)


def measure(scene: str, mode: str, hiding: bool, options: argparse.Namespace) -> None:
    """Run the drives of one scene in one mode, and print their scores together."""
    found, errors, squared, sizes, seconds, verdicts = np.zeros(4, dtype=int), [], [], [], 0.0, []
    for seed in range(options.drives):
        solids = desks(np.random.default_rng(seed)) if scene == "desks" else None
        log = hiding_drive(seed, hiding=hiding, pillars=scene == "pillars", joint=mode == "joint", solids=solids)
        begin = time.process_time()
        result = pipeline.run(log, load_settings(None, (f"mode={mode}", "output.recording=false", *options.set)), Ledger())
        seconds += time.process_time() - begin
        align, radius = "se2" if mode == "joint" else "none", 1.0 if scene == "desks" else 0.5
        scores = evaluate(result.map, log.truth, result.path_after, align=align, radius=radius).objects
        assert scores is not None
        if scene == "desks":
            scores = _of_desks(scores)
        found += [len(scores.matches), len(scores.matches) + len(scores.missed), len(scores.false), scores.unresolved]
        errors += scores.errors.tolist()
        squared += [m.squared_3d for m in scores.matches if m.squared_3d is not None]
        sizes += [m.body.size_error for m in scores.matches if m.body is not None]
        verdicts.append(result.summary["assessment"]["level"])
        for m in scores.matches if options.each else ():
            assert m.squared_3d is not None
            body = "" if m.body is None else f", size off by {np.round(m.body.size_error, 2)}"
            inside = "inside" if m.squared_3d <= INSIDE_95_3D else "OUTSIDE"
            print(f"  {m.truth.label}: {m.error:.3f} m, sigma {m.object.sigma:.3f} m, {inside}{body}")
    size = np.array(sizes).reshape(-1, 3)
    print(
        f"{scene:8}{mode:6}{'hiding' if hiding else 'whole':7}"
        f" found {found[0]} of {found[1]}, false {found[2]}, unresolved {found[3]};"
        f" error RMSE {np.sqrt(np.mean(np.square(errors))):.3f} median {np.median(errors):.3f} m;"
        f" inside 95 % {np.mean(np.array(squared) <= INSIDE_95_3D):.1%} (median {np.median(squared):.1f});"
        f" sizes off by {np.median(np.abs(size).mean(axis=1)):.1%}, median {np.median(size):+.1%};"
        f" {'/'.join(f'{verdicts.count(v)} {v}' for v in ('good', 'check', 'bad'))};"
        f" {seconds / options.drives:.1f} s CPU",
        flush=True,
    )


def _of_desks(scores: ObjectScores) -> ObjectScores:
    """Return the scores of the desks alone. Their labels begin with desk."""
    matches = tuple(one for one in scores.matches if one.truth.label.startswith("desk"))
    missed = tuple(one for one in scores.missed if one.label.startswith("desk"))
    return replace(
        scores, matches=matches, missed=missed, false=tuple(o for o in scores.false if o.label.startswith("desk"))
    )


if __name__ == "__main__":
    main()
