"""Measure how often two maps of one place are registered correctly, and how often maps of different places are accepted.

    python tools/bench_registration.py [--pairs 1000] [--different 1000] [--folders A B ...]

The maps have 10 to 200 objects of 3 to 10 labels and noise of 5 cm. They overlap by 30 to 100 %, and a fifth of the objects
has changed. `right` is the share of pairs that are registered within 0.1 m and 1 degree. `known` is this share for a fit to
the true matches, so no method can do much better. `inside 95 %` is the share of transforms that are as near to the truth as
their covariances say. The lines tell it by the number of shared objects. Then the tool registers a room to a row of three
rooms just like it. The times are CPU times. With --folders, the tool instead registers each of these result folders to the
others.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from association.registration_scenes import errors, of, place, rooms, twins

import objslam
from objslam.association.registration.map_registration import Registration, register_maps
from objslam.core.arrays import Floats
from objslam.core.geometry import align, split_se2

FEWEST = 6
"""The least number of shared objects of a pair that counts. A larger number makes the pairs easier."""
GROUPS = (6, 8, 10, 20, 1 << 30)
"""The bounds of the groups by number of shared objects. More bounds tell more, from fewer pairs each."""
INSIDE = 9.488
"""The squared Mahalanobis distance that 95 % of normal errors in four dimensions stay below."""


def within(shift: float, turn: float) -> bool:
    """Whether a transform meets the bar of 0.1 m and 1 degree."""
    return shift < 0.1 and turn < np.radians(1)


def squared_distance(found: Registration, truth: Floats) -> float:
    """Return the squared Mahalanobis distance of a transform from the true one, by its own covariance."""
    shift = found.b_T_a[:3, 3] - truth[:3, 3]
    turn = split_se2(found.b_T_a @ np.linalg.inv(truth))[0][2]
    off = np.array([*shift, turn])
    return float(off @ np.linalg.solve(found.covariance, off))


def same_places(rng: np.random.Generator, pairs: int) -> None:
    """Register pairs of maps of one place and print the shares."""
    rows, shared = [], []
    while len(rows) < pairs:
        a, b, truth, both = twins(rng, int(rng.integers(10, 201)), int(rng.integers(3, 11)), rng.uniform(0.3, 1))
        if len(both) < FEWEST:
            continue
        found = register_maps(a, b)
        at = a.position[both[:, 0]]
        known = align(at, b.position[both[:, 1]], "se2")[0]
        matched = set(map(tuple, both.tolist())) & set(map(tuple, found.matches.tolist()))
        shared.append(len(both))
        rows.append(
            (
                within(*errors(found.b_T_a, truth, at)),
                within(*errors(known, truth, at)),
                found.accepted,
                2 * len(matched) > len(both),
                squared_distance(found, truth) < INSIDE,
            )
        )
    table, count = np.array(rows), np.array(shared)
    print("same places         pairs  right  known  accepted  matches right  inside 95 %")
    groups = [("all", count >= FEWEST)]
    groups += [(f"{low} or more shared", (count >= low) & (count < high)) for low, high in pairwise(GROUPS)]
    for name, some in groups:
        if some.any():
            right, known_, accepted, place_found, inside = table[some].mean(axis=0)
            print(
                f"{name:18s}  {some.sum():5d}  {right:.3f}  {known_:.3f}  {accepted:8.3f}  {place_found:13.3f}"
                f"  {inside:11.3f}",
                flush=True,
            )


def different_places(rng: np.random.Generator, pairs: int) -> None:
    """Register pairs of maps of different places and print how many are accepted."""
    odds, accepted = [], 0
    for _ in range(pairs):
        labels = int(rng.integers(3, 11))
        found = register_maps(*(of(*place(rng, int(rng.integers(10, 201)), labels)) for _ in range(2)))
        odds.append(found.log_odds)
        accepted += found.accepted
    print(f"{pairs} different places: accepted {accepted}, highest log odds {max(odds):.1f}")


def equal_rooms(rng: np.random.Generator, places: int = 100) -> None:
    """Register one room to three rooms just like it, and print the verdicts."""
    verdicts = []
    for _ in range(places):
        points, labels, three, of_three = rooms(rng)
        verdicts.append(register_maps(of(points, labels), of(three, of_three)).verdict)
    print(f"{places} rooms in a row of three equal ones: {dict(Counter(verdicts))}", flush=True)


def large(rng: np.random.Generator) -> None:
    """Time maps of 1,000 objects."""
    for overlap in (1.0, 0.5, 0.3):
        a, b, truth, both = twins(rng, 1000, 10, overlap)
        begin = time.process_time()
        found = register_maps(a, b)
        seconds = time.process_time() - begin
        right = within(*errors(found.b_T_a, truth, a.position[both[:, 0]]))
        print(f"1000 x 1000, overlap {overlap}: {seconds:.2f} s, right {right}", flush=True)


def folders(names: list[str]) -> None:
    """Register maps on disk to each other."""
    maps = {name: objslam.ObjectMap.load(name) for name in names}
    for one in names:
        for other in names:
            if one != other:
                found = objslam.register(maps[one], maps[other])
                print(
                    one,
                    other,
                    found.verdict,
                    f"{len(found.matches)} matches, log odds {found.log_odds:.1f}, lead {found.lead:.1f}",
                )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--different", type=int, default=1000)
    parser.add_argument("--folders", nargs="+", default=[])
    given = parser.parse_args()
    if given.folders:
        folders(given.folders)
    else:
        same_places(np.random.default_rng(0), given.pairs)
        equal_rooms(np.random.default_rng(3))
        large(np.random.default_rng(1))
        different_places(np.random.default_rng(2), given.different)
