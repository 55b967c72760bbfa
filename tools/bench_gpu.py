"""Measure the three kinds of work of objslam that run on a CUDA device, beside the card's own copy bandwidth.

    python tools/bench_gpu.py                # says so in one line, and ends with 0, if there is no device
    python tools/bench_gpu.py --device cpu   # the same rows on the CPU

They are Eq. 1 (`minimise_distances`), the consensus of triangulation, and the scores of association. A consensus scores one
point for each object by the rays that agree with it (`consensus_about`), or the best of many pairs of rays (`best_pair`).
Association scores many points by all rays (`supports`). A row has the time of one call, and the bytes that the call must
move at the least, as a share of what the card copies in that time. The least is the input of each step once, or the scores
once if there are more of them, and no other intermediate result. So a small share can mean a slow kernel, or a kernel that
computes much with each number.

The last rows have the time of a whole triangulation, from and to arrays of numpy, beside that of numpy on one core.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from bench_triangulation import scene

from objslam import config
from objslam.association.hypothesis_search import Search, _Scorer
from objslam.association.observations import Observations
from objslam.core.array_module import Backend, as_tensor, module_of
from objslam.triangulation import ac_ransac
from objslam.triangulation.bundle import Bundle
from objslam.triangulation.point_to_lines import minimise_distances
from objslam.triangulation.triangulate import triangulate

SIZES = ((1_000, 50), (4_000, 50), (20_000, 50), (100_000, 50))
"""The numbers of objects, and of rays of each."""
HYPOTHESES = config.Triangulation().hypotheses
"""The pairs of rays that are tried for each object."""
COPIED = 1 << 28
"""The bytes of the array whose copy measures the bandwidth. It must be larger than all caches of the device."""
REPEATS = 5
"""The timed calls of each kind, of which the median counts, after one call that warms up."""
RAY = 7 * 8
"""The bytes of a ray in a step of Eq. 1: a foot, a direction and a weight, in double precision."""
NOISE = 0.006
"""The noise of the rays, rad."""
POINTS = 2_000
"""The points that association scores by all rays."""
SCORED = 200_000
"""The most rays by which association scores points, so that the scores fit into the memory of a small card."""
WHOLE = 1_000_000
"""The most rays of a whole triangulation, which takes numpy 10 s."""


def seconds(work: Callable[[], Any], wait: Callable[[], Any]) -> float:
    """Return the median time, s, of a call. wait: waits for the device."""
    times = []
    for _ in range(REPEATS + 1):
        wait()
        begin = time.perf_counter()
        work()
        wait()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[1:])


def bundle_of(objects: int, rays: int, device: Backend) -> Bundle:
    """Return the rays of `bench_triangulation.scene`, seen from the mean origin of each object, on a device."""
    origins, directions, index = scene(objects, rays, 0.2, NOISE)
    origins -= origins.reshape(objects, rays, 3).mean(axis=1)[index]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    noise, number = np.full(len(index), NOISE), np.full(objects, rays)
    origin, direction, sigma, owner, count = (as_tensor(one, device) for one in (origins, directions, noise, index, number))
    return Bundle(origin, direction, sigma, 0.0, owner, count, module_of(origin))


def scorer_of(objects: int, rays: int, device: Backend) -> Any:
    """Return the scorer of association for the rays of `bench_triangulation.scene`, with a frame for each five rays."""
    origins, directions, index = scene(objects, rays, 0.2, NOISE)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    noise, unknown = np.full(len(index), NOISE), np.full(len(index), np.nan)
    seen = Observations.of_lines(origins, directions, noise, unknown, unknown)
    search = Search(hypotheses=POINTS, support=3.0, gate=13.8, parallax=0.03, device=device)
    return _Scorer(replace(seen, frame=np.arange(len(index)) // 5), search, device)


def whole(objects: int, rays: int, device: str) -> float:
    """Return the time, s, of a whole triangulation from arrays of numpy, after one that warms up."""
    lines = scene(objects, rays, 0.2, NOISE)
    settings = config.Triangulation.model_validate({"device": device})
    for _ in range(2):
        begin = time.perf_counter()
        triangulate(*lines, objects, NOISE, settings)
        took = time.perf_counter() - begin
    return took


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--most", type=int, default=SIZES[-1][0], help="leave out sizes with more objects than this")
    parser.add_argument(
        "--peak", type=float, default=None, help="the bandwidth of the card's data sheet, GB/s, for comparison"
    )
    asked = parser.parse_args()
    if find_spec("torch") is None:
        print("no GPU was measured: torch is not installed")
        return 0
    import torch

    if asked.device == "cuda" and not torch.cuda.is_available():
        print("no GPU was measured: torch sees no CUDA device")
        return 0
    device: Backend = asked.device
    wait = torch.cuda.synchronize if device == "cuda" else (lambda: None)
    source = torch.ones(COPIED // 8, dtype=torch.float64, device=device)
    target = torch.empty_like(source)
    bandwidth = 2 * COPIED / seconds(lambda: target.copy_(source), wait)  # A copy reads and writes each byte.
    name = torch.cuda.get_device_name() if device == "cuda" else f"the CPU, {torch.get_num_threads()} threads"
    stated = (
        "" if asked.peak is None else f", {bandwidth / asked.peak / 1e7:.0f} % of the {asked.peak:g} GB/s of its data sheet"
    )
    print(f"{name}, torch {torch.__version__}: a copy moves {bandwidth / 1e9:.0f} GB/s{stated}")
    print(f"{'work':<24}{'objects':>9}{'rays':>12}{'time':>12}{'rays/s':>12}{'at least':>11}{'of a copy':>11}")
    for objects, rays in SIZES:
        if objects > asked.most:
            continue
        bundle = bundle_of(objects, rays, device)
        jitter = as_tensor(np.random.default_rng(0).random(HYPOTHESES), device)
        every, solved = torch.arange(objects, device=device), minimise_distances(bundle)
        number = objects * rays
        work: dict[str, tuple[Callable[[], Any], float]] = {
            "Eq. 1": (lambda: minimise_distances(bundle), RAY * number * solved.iterations),  # noqa: B023
            "score of one point": (lambda: ac_ransac.consensus_about(bundle, solved.point[:, None], every), RAY * number),  # noqa: B023
            f"best of {HYPOTHESES} pairs": (
                lambda: ac_ransac.best_pair(bundle, every, HYPOTHESES, jitter),  # noqa: B023
                2 * 4 * number * HYPOTHESES,  # The score of each ray and pair is written and read once, in single precision.
            ),
        }
        if number <= SCORED:
            scorer = scorer_of(objects, rays, device)
            points = scorer.load(np.random.default_rng(0).uniform(-20, 20, (POINTS, 3)))
            # The score of each ray and point is written, in single or double precision.
            least = scorer.ahead.dtype.itemsize * number * POINTS
            work[f"{POINTS:,} points' support"] = (lambda: scorer.supports(points), least)  # noqa: B023
        for kind, (call, least) in work.items():
            took = seconds(call, wait)
            rate = least / took
            print(
                f"{kind:<24}{objects:>9,}{number:>12,}{1e3 * took:>9.2f} ms{number / took:>12.3g}{rate / 1e9:>6.1f} GB/s"
                f"{100 * rate / bandwidth:>9.1f} %",
                flush=True,
            )
    for objects, rays in SIZES:
        if device == "cuda" and objects <= asked.most and objects * rays <= WHOLE:
            card, core = whole(objects, rays, "cuda"), whole(objects, rays, "cpu")
            print(
                f"{'whole triangulation':<24}{objects:>9,}{objects * rays:>12,}{1e3 * card:>9.2f} ms,"
                f" numpy {1e3 * core:.0f} ms: {core / card:.1f} times as fast"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
