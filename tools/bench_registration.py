"""Measure how often two maps of one place are registered correctly, and how often maps of different places are accepted.

    python tools/bench_registration.py [--pairs 200] [--different 1000] [--folders A B ...]

The maps have 10 to 200 objects of 3 to 10 labels and noise of 5 cm. They overlap by 30 to 100 %, and a fifth of the objects
has changed. `right` is the share of pairs that are registered within 0.1 m and 1 degree. `known` is this share for a fit to
the true matches, so no method can do much better. With --folders, the tool instead registers each of these result folders to
the others.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from association.registration_scenes import errors, of, place, twins

import objslam
from objslam.association.registration.map_registration import register_maps
from objslam.core.geometry import align

FEWEST = 6
"""The least number of shared objects of a pair that counts. A larger number makes the pairs easier."""


def within(shift: float, turn: float) -> bool:
    """Whether a transform meets the bar of 0.1 m and 1 degree."""
    return shift < 0.1 and turn < np.radians(1)


def same_places(rng: np.random.Generator, pairs: int) -> None:
    """Register pairs of maps of one place and print the shares."""
    rows = []
    while len(rows) < pairs:
        a, b, truth, both = twins(rng, int(rng.integers(10, 201)), int(rng.integers(3, 11)), rng.uniform(0.3, 1))
        if len(both) < FEWEST:
            continue
        found = register_maps(a, b)
        at = a.position[both[:, 0]]
        known = align(at, b.position[both[:, 1]], "se2")[0]
        matched = set(map(tuple, both.tolist())) & set(map(tuple, found.matches.tolist()))
        rows.append(
            (
                within(*errors(found.b_T_a, truth, at)),
                within(*errors(known, truth, at)),
                found.accepted,
                2 * len(matched) > len(both),
            )
        )
    right, known, accepted, place_found = np.mean(rows, axis=0)
    print(
        f"{pairs} same places: right {right:.3f}  known {known:.3f}  accepted {accepted:.3f}"
        f"  matches right {place_found:.3f}"
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


def large(rng: np.random.Generator) -> None:
    """Time maps of 1,000 objects."""
    for overlap in (1.0, 0.5, 0.3):
        a, b, truth, both = twins(rng, 1000, 10, overlap)
        begin = time.perf_counter()
        found = register_maps(a, b)
        seconds = time.perf_counter() - begin
        right = within(*errors(found.b_T_a, truth, a.position[both[:, 0]]))
        print(f"1000 x 1000, overlap {overlap}: {seconds:.2f} s, right {right}")


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
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--different", type=int, default=1000)
    parser.add_argument("--folders", nargs="+", default=[])
    given = parser.parse_args()
    if given.folders:
        folders(given.folders)
    else:
        same_places(np.random.default_rng(0), given.pairs)
        large(np.random.default_rng(1))
        different_places(np.random.default_rng(2), given.different)
