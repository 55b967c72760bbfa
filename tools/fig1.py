"""The experiment of Staszak & Belter's Fig. 1: lines that meet at (0, 0, 1) among random ones, Eq. 1 alone and consensus.

    python tools/fig1.py [--seeds 200] [--noise 0.002]

prints the median distance (m) of the solution from the meeting point, over seeds, for 0, 7, 20 and 40 random lines.
"""

from __future__ import annotations

import argparse

import numpy as np

from objslam import config
from objslam.triangulation import triangulate

MEETING = np.array([0.0, 0.0, 1.0])
GOOD = 7


def lines(outliers: int, noise: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of 7 noisy lines (rad) through the meeting point and of random ones, all from the floor."""
    origins = rng.uniform(-2.0, 2.0, size=(GOOD + outliers, 3)) * [1.0, 1.0, 0.0]
    directions = rng.normal(size=origins.shape)
    good = MEETING - origins[:GOOD]
    directions[:GOOD] = good / np.linalg.norm(good, axis=1, keepdims=True) + noise * rng.normal(size=(GOOD, 3))
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def errors(outliers: int, noise: float, seeds: int, consensus: bool) -> np.ndarray:
    """Distance (seeds,) m of each seed's solution from the meeting point, all seeds in one batch."""
    batch = [lines(outliers, noise, np.random.default_rng(seed)) for seed in range(seeds)]
    index = np.repeat(np.arange(seeds), GOOD + outliers)
    origins, directions = (np.concatenate(part) for part in zip(*batch, strict=True))
    settings = config.Triangulation(consensus=consensus)
    result = triangulate(origins, directions, index, seeds, noise, settings)
    return np.linalg.norm(result.positions - MEETING, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--noise", type=float, default=0.002, help="rad")
    args = parser.parse_args()
    print(f"median error (m) over {args.seeds} seeds, {GOOD} lines with {1e3 * args.noise:g} mrad noise plus random lines")
    print(f"{'random lines':>14}{'Eq. 1 alone':>14}{'consensus':>14}{'worst 5 %':>14}")
    for outliers in (0, 7, 20, 40):
        alone = errors(outliers, args.noise, args.seeds, consensus=False)
        agreed = errors(outliers, args.noise, args.seeds, consensus=True)
        print(f"{outliers:14d}{np.median(alone):14.4f}{np.median(agreed):14.4f}{np.quantile(agreed, 0.95):14.4f}")


if __name__ == "__main__":
    main()
