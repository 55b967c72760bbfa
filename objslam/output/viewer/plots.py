"""Log plots to a recording.

Curves show residuals and ray counts by stamp, and cost and object counts by iteration. Bars show the time of each stage.
"""

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.result import RunResult
from objslam.core.statistics import grouped_quantile
from objslam.core.trace import Parameters
from objslam.output.plot.style import ray_kinds
from objslam.output.viewer.rays import RAY_COLOURS
from objslam.output.viewer.times import iteration_column, stamp_column

_GAP, _GAP_STEPS = 1.0, 5.0
"""The limits for a gap in a curve. A pause is a gap if it is longer than `_GAP` (s) and than `_GAP_STEPS` times the median
step between stamps. Larger values make fewer gaps."""
_BLUE, _ORANGE, _GREEN, _GREY = (62, 128, 214), (240, 150, 50), (90, 170, 90), (120, 120, 120)  # RGB, of curves.
_MANY = (
    *(_BLUE, _ORANGE, _GREEN, (190, 70, 70), (140, 90, 190), (140, 100, 80)),
    *((220, 120, 190), _GREY, (180, 180, 50), (60, 180, 200)),
)
"""The colours of a plot with many curves. The eleventh curve has the first colour again."""


def log_residuals(recording: Any, result: RunResult) -> None:
    """Log by stamp: the residuals, deg, of used rays, `plots/residual`, and the ray counts by kind, `plots/boxes/KIND`."""
    stamps, moment = np.unique(result.keyframes.stamps, return_inverse=True)
    of = moment[result.rays.keyframe]
    kinds = ray_kinds(result)
    used = kinds["used"]
    degrees = np.degrees(result.residual[used])
    step = np.diff(stamps)
    gap = np.flatnonzero(step > max(_GAP, _GAP_STEPS * float(np.median(step)))) if len(step) else np.zeros(0, dtype=np.int64)
    at = stamp_column(np.insert(stamps, gap + 1, stamps[gap] + step[gap] / 2))  # No line crosses a gap.
    for name, share, colour in (("median", 0.5, _BLUE), ("worst", 1.0, _ORANGE)):
        curve = np.insert(grouped_quantile(degrees, of[used], len(stamps), share), gap + 1, np.nan)
        if np.isfinite(curve).any():
            _send(recording, f"plots/residual/{name}", at, curve, colour, f"{name} residual, deg")
    for kind, mask in kinds.items():
        counts = np.bincount(of[mask], minlength=len(stamps)).astype(np.float64)
        _send(recording, f"plots/boxes/{kind}", stamp_column(stamps), counts, RAY_COLOURS[kind], kind)


def log_costs(recording: Any, result: RunResult) -> None:
    """Log curves by iteration: the cost, `plots/cost`, and the counts of objects and unexplained rays, `plots/rounds`.

    `plots/seconds` has a bar for the time of each stage, in the order of the table in `summary`.
    """
    if seconds := result.summary.get("seconds", {}):
        recording.log("plots/seconds", rr.BarChart(list(seconds.values()), color=_BLUE), static=True)
    steps = [(i.stage, i.cost, r.association) for r in result.trace for i in r.iterations]
    numbers = np.arange(len(steps))
    stage, cost = np.array([stage for stage, _, _ in steps]), np.array([cost for _, cost, _ in steps])
    for which, name, colour in (("solve", "cost of the graph", _BLUE), ("grow", "cost while it grows", _GREY)):
        some = (stage == which) & np.isfinite(cost)
        if some.any():
            _send(recording, f"plots/cost/{which}", iteration_column(numbers[some]), cost[some], colour, name)
    if len(numbers):
        at = iteration_column(numbers)
        objects = np.array([float(found.count) for _, _, found in steps])
        unexplained = np.array([float((found.object < 0).sum()) for _, _, found in steps])
        _send(recording, "plots/rounds/objects", at, objects, _GREEN, "objects")
        _send(recording, "plots/rounds/unexplained", at, unexplained, _GREY, "rays that no object explains")


def log_parameters(recording: Any, result: RunResult) -> None:
    """Log the shared errors by iteration, in standard deviations of their priors.

    `plots/calibration/NAME` has the value of a shared error. `plots/calibration_sigma/NAME` has its standard deviation, 1 at
    the start. The last points are the result of the run.
    """
    if result.calibration is None or not result.trace:
        return
    prior = dict(zip(result.calibration.names, result.calibration.prior.tolist(), strict=True))
    rows: list[tuple[int, Parameters]] = []
    at = 0
    for one in result.trace:
        rows += [(at + i, step.parameters) for i, step in enumerate(one.iterations) if step.parameters is not None]
        at += len(one.iterations)
    found = result.calibration
    rows.append((max(at - 1, 0), Parameters(found.names, found.values, found.sigma)))
    for i, name in enumerate(found.names):
        # An earlier solve may have had fewer shared errors than the last one.
        steps = [(number, row, row.names.index(name)) for number, row in rows if name in row.names]
        numbers = np.array([number for number, _, _ in steps])
        begun = np.append(max(numbers[0] - 1, 0), numbers)
        values = np.array([row.values[k] / prior[name] for _, row, k in steps])
        sigma = np.array([1.0, *(row.sigma[k] / prior[name] for _, row, k in steps)])
        colour = _MANY[i % len(_MANY)]
        part = rr.escape_entity_path_part(name)
        _send(recording, f"plots/calibration/{part}", iteration_column(numbers), values, colour, name)
        _send(recording, f"plots/calibration_sigma/{part}", iteration_column(begun), sigma, colour, name)


def _send(recording: Any, path: str, at: Any, values: Any, colour: tuple[int, int, int], name: str) -> None:
    recording.send_columns(path, [at], rr.Scalars.columns(scalars=values))
    recording.log(path, rr.SeriesLines(colors=[colour], names=[name], widths=[1.5]), static=True)
