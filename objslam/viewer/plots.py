"""Curves: how far the rays of a frame pass their objects, what the boxes of a frame are, cost and objects by iteration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.association.extent import grouped_quantile
from objslam.scene import ray_kinds
from objslam.types import Floats
from objslam.viewer.rays import RAY_COLOURS
from objslam.viewer.times import iteration_column, stamp_column

if TYPE_CHECKING:
    from objslam.results import RunResult

_GAP, _GAP_STEPS = 1.0, 5.0  # s, and the usual steps between stamps: a longer pause is one without boxes
_CURVES = ((62, 128, 214), (240, 150, 50), (90, 170, 90), (170, 110, 200), (200, 90, 90), (120, 120, 120))


def log_residuals(recording: Any, result: RunResult) -> None:
    """`plots/residual/median` and `.../worst`, deg, of the used rays of a stamp, broken where there are none;
    `plots/boxes/KIND`, how many there are.
    """
    stamps, moment = np.unique(result.keyframes.stamps, return_inverse=True)
    of = moment[result.rays.keyframe]
    kinds = ray_kinds(result)
    used = kinds["used"]
    degrees = np.degrees(result.residual[used])
    for name, share, colour in (("median", 0.5, _CURVES[0]), ("worst", 1.0, _CURVES[1])):
        at, curve = broken(stamps, grouped_quantile(degrees, of[used], len(stamps), share))
        if np.isfinite(curve).any():
            _send(recording, f"plots/residual/{name}", stamp_column(at), curve, colour, f"{name} residual, deg")
    for kind, mask in kinds.items():
        counts = np.bincount(of[mask], minlength=len(stamps)).astype(np.float64)
        _send(recording, f"plots/boxes/{kind}", stamp_column(stamps), counts, RAY_COLOURS[kind], kind)


def broken(stamps: Floats, values: Floats) -> tuple[Floats, Floats]:
    """A curve (N,) at ascending stamps (N,), s, with a NaN in the middle of each gap, so that no line crosses it."""
    step = np.diff(stamps)
    gap = np.flatnonzero(step > max(_GAP, _GAP_STEPS * float(np.median(step)))) if len(step) else np.zeros(0, dtype=np.int64)
    return np.insert(stamps, gap + 1, stamps[gap] + step[gap] / 2), np.insert(values, gap + 1, np.nan)


def log_costs(recording: Any, result: RunResult) -> None:
    """`plots/cost/solve` and `plots/cost/grow` by iteration; `plots/rounds`, objects and unexplained rays of its round."""
    stages, costs, objects, unexplained = [], [], [], []
    for r in result.trace:
        for i in r.iterations:
            stages.append(i.stage)
            costs.append(i.cost)
            objects.append(float(r.association.count))
            unexplained.append(float((r.association.object < 0).sum()))
    numbers, cost, stage = np.arange(len(costs)), np.array(costs), np.array(stages)
    for which, name in (("solve", "cost of the graph"), ("grow", "cost while it grows")):
        some = (stage == which) & np.isfinite(cost)
        if some.any():
            colour = _CURVES[0] if which == "solve" else _CURVES[5]
            _send(recording, f"plots/cost/{which}", iteration_column(numbers[some]), cost[some], colour, name)
    if len(numbers):
        at = iteration_column(numbers)
        _send(recording, "plots/rounds/objects", at, np.array(objects), _CURVES[2], "objects")
        _send(recording, "plots/rounds/unexplained", at, np.array(unexplained), _CURVES[5], "rays that none explains")


def _send(recording: Any, path: str, at: Any, values: Any, colour: tuple[int, int, int], name: str) -> None:
    import rerun as rr

    recording.send_columns(path, [at], rr.Scalars.columns(scalars=values))
    recording.log(path, rr.SeriesLines(colors=[colour], names=[name], widths=[1.5]), static=True)


def log_seconds(recording: Any, seconds: dict[str, float]) -> None:
    """`plots/seconds`: a bar for each stage of the run, in their order (`summary` names them)."""
    import rerun as rr

    if seconds:
        recording.log("plots/seconds", rr.BarChart(list(seconds.values()), color=_CURVES[0]), static=True)
