"""Measure how well association finds objects whose identities are unknown, and how long it takes.

    python tools/bench_association.py [--seeds 20] [--parts scenes speed drift ...] [--picture PNG]

scenes: simulated drives with known poses. speed: the time and memory for a short and a long log. drift: simulated drives
from odometry alone, whose poses and objects are estimated together. unnamed: drives of peers/drives.py, mapped with and
without the names of their landmarks (tools/bench_recordings.py has more recordings without names). street: poles seen from
a few places with the noise of GPS, beside a Markov random field. appearance: clusters of objects of one label, with and
without appearance vectors, of which a fifth confuse the object.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from association_parts.from_odometry import drift, unnamed
from association_parts.scenes import scenes, speed
from association_parts.streets import street
from association_parts.vectors import appearance

PARTS = ("scenes", "speed", "drift", "unnamed", "street", "appearance")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--picture", type=Path, help="write a PNG of the map of the first drive of `drift`")
    arguments = parser.parse_args()
    seeds = arguments.seeds
    work = {
        "scenes": lambda: scenes(seeds),
        "speed": lambda: [speed(frames) for frames in (3_500, 33_500)],
        "drift": lambda: drift(seeds, arguments.picture),
        "unnamed": unnamed,
        "street": lambda: street(seeds),
        "appearance": lambda: appearance(seeds),
    }
    for part in PARTS:
        if part in arguments.parts:
            work[part]()


if __name__ == "__main__":
    main()
