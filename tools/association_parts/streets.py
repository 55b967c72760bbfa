"""Poles along a street, seen from a few places with the noise of GPS, beside a Markov random field."""

from __future__ import annotations

import time

import numpy as np
from peers.krylov import locate
from peers.street import Street, simulate_street

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.evaluation.alignment import match_points
from objslam.mapping import pipeline


def street(seeds: int) -> None:
    """Print how many poles of simulated streets are found within 4 m, and how often an existence is right.

    Precision counts all found objects, recall those poles that were seen twice or more. The Markov random field runs with
    its authors' distance between crossings of one object, and with three times this distance, which suits this noise better.
    """
    said: list[tuple[float, bool]] = []
    rows: dict[str, Ints] = {}
    begin = time.process_time()
    for seed in range(seeds):
        scene = simulate_street(seed)
        for name, told in (("objslam, noise told", True), ("objslam, noise not told", False)):
            result = pipeline.run(scene.log, scene.settings(told), Ledger())
            objects = result.map.resolved()
            points = np.array([o.position[:2] for o in objects]).reshape(-1, 2)
            counts, right = street_counts(scene, points)
            rows[name] = rows.get(name, np.zeros(4, dtype=np.int64)) + counts
            if told:
                said += [(o.existence, i in right) for i, o in enumerate(objects) if o.existence is not None]
        for metres in (1.0, 3.0):
            points = locate(scene.origin, scene.heading, scene.range, scene.place, seed, metres)
            name = f"Markov random field, {metres:g} m"
            rows[name] = rows.get(name, np.zeros(4, dtype=np.int64)) + street_counts(scene, points)[0]
    print(f"{'street':<28}{'precision':>10}{'recall':>8}   ({seeds} seeds, {time.process_time() - begin:.0f} s of CPU)")
    for name, (right_count, found, twice, of) in rows.items():
        print(f"{name:<28}{right_count / max(found, 1):>10.3f}{twice / max(of, 1):>8.3f}")
    existence, hit = np.array([e for e, _ in said]), np.array([h for _, h in said])
    for low in np.arange(0.5, 1.0, 0.1).tolist():
        mine = (existence >= low) & (existence < low + 0.1 + 1e-6)
        if mine.any():
            print(
                f"existence {low:.1f} to {low + 0.1:.1f}: {int(mine.sum()):5d} objects, {hit[mine].mean():.2f} of them right"
            )


def street_counts(scene: Street, points: Floats) -> tuple[Ints, set[int]]:
    """Return the numbers of points (N, 2) that are right, of points, of poles seen twice that are found, and of such poles.
    Also return the points that are right."""
    found, true = match_points(points, scene.objects, np.ones((len(points), len(scene.objects)), dtype=bool), 4.0)
    twice = scene.views >= 2
    return np.array([len(found), len(points), twice[true].sum(), twice.sum()]), set(found.tolist())
