"""Compare objslam with hand-written graphs on the same drives with known names: CPU seconds, error and memory.

OBJSLAM_DATA=... python tools/bench_peers.py                 # all drives and all ways to solve them; a few minutes
OBJSLAM_DATA=... python tools/bench_peers.py --drive woods   # the drives whose name has these letters

Each solve runs in a process of its own. The error is the RMSE of the landmarks after an SE(2) alignment with the truth. If
the truth is unknown, the solution of GTSAM's iSAM2 replaces it, which is the right minimum for the noise that the drive
states. One line for each drive or way that is left out says why.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from peers.drives import drives
from peers.graphs import PEERS, REFERENCE, Solved

from objslam.core.arrays import Floats
from objslam.core.geometry import align

_QUADRICS = (
    "gtsam-quadrics 0.3.0: left out. It needs Python 3.10 and numpy below 1.24, "
    "and the sizes of boxes, which these drives lack."
)


def main() -> None:
    """Print a table for each drive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drive", default="", help="solve only the drives whose name has these letters")
    parser.add_argument("--peer", default="", help="solve only in the ways whose name has these letters")
    asked = parser.parse_args()
    data = os.environ.get("OBJSLAM_DATA")
    for name, known in drives(Path(data) if data else None).items():
        if asked.drive.lower() not in name.lower():
            continue
        if isinstance(known, str):
            print(f"{name}: left out, {known}")
            continue
        drive = known()
        print(f"{name}: {len(drive.poses)} poses, {drive.count} landmarks, {len(drive.frame)} observations")
        reference, against = drive.truth, "truth"
        if reference is None:
            solved = in_process(name, REFERENCE)[0]
            if isinstance(solved, str):
                print(f"  no reference: {solved}")
                continue
            reference, against = solved[2], "iSAM2"
        for peer in PEERS:
            if asked.peer.lower() not in peer.lower():
                continue
            solved, peak = in_process(name, peer)
            if isinstance(solved, str):
                print(f"  {peer:24s} left out: {solved}")
                continue
            build, solve, points = solved
            off, compared = error(points, reference)
            print(
                f"  {peer:24s} build {build:6.2f} s, solve {solve:6.2f} s, error {off:.3f} m of {compared} against "
                f"{against}, {peak:4.0f} MB",
                flush=True,
            )
    print(_QUADRICS)


def in_process(drive: str, peer: str) -> tuple[Solved | str, float]:
    """Solve a drive in a new process. Return the solution, and the most memory of the process, MB."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_solve, args=(drive, peer, theirs))
    process.start()
    theirs.close()
    try:
        solved, peak = ours.recv()
    except EOFError:
        solved, peak = "its process ended without a solution", 0.0
    process.join()
    return solved, peak


def _solve(name: str, peer: str, answer: Connection) -> None:
    data = os.environ.get("OBJSLAM_DATA")
    known = drives(Path(data) if data else None)[name]
    assert not isinstance(known, str)
    drive = known()
    try:
        solved: Solved | str = PEERS[peer](drive)
    except (RuntimeError, ValueError) as failure:  # GTSAM's and objslam's errors
        solved = f"it failed: {str(failure).splitlines()[0] if str(failure) else type(failure).__name__}"
    answer.send((solved, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def error(points: Floats, reference: Floats) -> tuple[float, int]:
    """Return the RMSE (m) of landmarks (N, 2) after an SE(2) alignment, and the number of landmarks that were compared."""
    known = np.isfinite(points).all(axis=1) & np.isfinite(reference).all(axis=1)
    if not known.any():
        return float("nan"), 0
    source, target = (np.column_stack([p[known], np.zeros(known.sum())]) for p in (points, reference))
    pose, _ = align(source, target, "se2")
    moved = source @ pose[:3, :3].T + pose[:3, 3]
    return float(np.sqrt(((moved - target) ** 2).sum(axis=1).mean())), int(known.sum())


if __name__ == "__main__":
    main()
