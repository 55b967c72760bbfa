"""Repeat the experiment of Staszak & Belter's Fig. 1 with Eq. 1 alone and with consensus.

    python tools/fig1.py [--seeds 200] [--noise 0.002] [-o docs/fig1.png]

7 noisy lines meet at (0, 0, 1), among 0, 7, 20 or 40 random lines. The tool prints the median distance, m, of the solution
from the meeting point over all seeds. With -o, it also draws one seed with 0, 7 and 20 random lines in 3D.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from objslam import config
from objslam.triangulation.triangulate import triangulate

MEETING = np.array([0.0, 0.0, 1.0])
GOOD = 7
SHOWN = (0, 7, 20)
LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.4])


def lines(outliers: int, noise: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of 7 noisy lines (rad) through the meeting point and of random ones, all from the floor."""
    origins = rng.uniform(-2.0, 2.0, size=(GOOD + outliers, 3)) * [1.0, 1.0, 0.0]
    directions = rng.normal(size=origins.shape)
    good = MEETING - origins[:GOOD]
    directions[:GOOD] = good / np.linalg.norm(good, axis=1, keepdims=True) + noise * rng.normal(size=(GOOD, 3))
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def solutions(outliers: int, noise: float, seeds: range, consensus: bool) -> np.ndarray:
    """Where each seed's lines put the object (seeds, 3), m, all seeds in one batch."""
    batch = [lines(outliers, noise, np.random.default_rng(seed)) for seed in seeds]
    index = np.repeat(np.arange(len(batch)), GOOD + outliers)
    origins, directions = (np.concatenate(part) for part in zip(*batch, strict=True))
    settings = config.Triangulation(consensus=consensus)
    return triangulate(origins, directions, index, len(batch), noise, settings).positions


def errors(outliers: int, noise: float, seeds: int, consensus: bool) -> np.ndarray:
    """Distance (seeds,) m of each seed's solution from the meeting point."""
    return np.linalg.norm(solutions(outliers, noise, range(seeds), consensus) - MEETING, axis=1)


def within(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The part (2, 3) of a line that lies in the box of the picture."""
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([(LOW - origin) / direction, (HIGH - origin) / direction]), axis=0)
    return origin + np.array([ends[0].max(), ends[1].min()])[:, None] * direction


def draw(noise: float, seed: int, file: Path) -> None:
    """The lines and both solutions of one seed for each number of random lines, side by side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.1), dpi=100)
    FigureCanvasAgg(figure)
    for panel, outliers in enumerate(SHOWN):
        axes: Any = figure.add_axes((0.332 * panel - 0.004, 0.02, 0.335, 0.98), projection="3d")
        origins, directions = lines(outliers, noise, np.random.default_rng(seed))
        for i in reversed(range(len(origins))):
            good = i < GOOD
            style = {"color": "#2672c9", "linewidth": 1.5} if good else {"color": "#9aa0a8", "linewidth": 0.9}
            axes.plot(
                *within(origins[i], directions[i]).T, label="lines" if not i else "random" if i == GOOD else None, **style
            )
        axes.plot(*MEETING, "o", color="none", markeredgecolor="black", markersize=15, markeredgewidth=1.6, label="truth")
        found = {}
        for name, consensus, style in (
            ("Eq. 1 alone", False, {"marker": "X", "color": "#d9822b"}),
            ("with consensus", True, {"marker": "P", "color": "#c0282d"}),
        ):
            (point,) = solutions(outliers, noise, range(seed, seed + 1), consensus)
            found[name] = np.linalg.norm(point - MEETING)
            axes.plot(*point, linestyle="", markersize=8, markeredgecolor="white", markeredgewidth=0.7, label=name, **style)
            axes.plot(*np.stack([point, point * [1, 1, 0]]).T, ":", color=style["color"], linewidth=1.0)
        axes.set_xlim(LOW[0], HIGH[0])
        axes.set_ylim(LOW[1], HIGH[1])
        axes.set_zlim(LOW[2], HIGH[2])
        axes.set_box_aspect(HIGH - LOW, zoom=0.97)
        axes.set_xticks([-2, -1, 0, 1, 2])
        axes.set_yticks([-2, -1, 0, 1, 2])
        axes.set_zticks([0, 1, 2])
        axes.set_facecolor("none")  # it would cover the figures of the one beside it
        axes.view_init(elev=20, azim=-58)
        axes.tick_params(labelsize=6.5, pad=-3)
        axes.set_title(
            f"{GOOD} lines and {outliers or 'no'} random ones\nerror: "
            + ", ".join(f"{name} {error:.3f} m" for name, error in found.items()),
            fontsize=9.5,
            y=0.96,
        )
    handles, labels = axes.get_legend_handles_labels()
    order = [labels.index(name) for name in ("lines", "random", "truth", "Eq. 1 alone", "with consensus")]
    handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    figure.legend(handles, labels, loc="lower center", ncols=5, fontsize=9, frameon=False)
    figure.savefig(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--noise", type=float, default=0.002, help="the noise of the directions, rad")
    parser.add_argument("-o", "--out", type=Path, help="write a PNG of one seed")
    parser.add_argument("--seed", type=int, default=0, help="the seed in the picture")
    args = parser.parse_args()
    if args.out:
        draw(args.noise, args.seed, args.out)
    print(f"median error (m) over {args.seeds} seeds, {GOOD} lines with {1e3 * args.noise:g} mrad noise plus random lines")
    print(f"{'random lines':>14}{'Eq. 1 alone':>14}{'consensus':>14}{'worst 5 %':>14}")
    for outliers in (0, 7, 20, 40):
        alone = errors(outliers, args.noise, args.seeds, consensus=False)
        agreed = errors(outliers, args.noise, args.seeds, consensus=True)
        print(f"{outliers:14d}{np.median(alone):14.4f}{np.median(agreed):14.4f}{np.quantile(agreed, 0.95):14.4f}")


if __name__ == "__main__":
    main()
