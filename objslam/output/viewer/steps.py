"""The estimation step by step: path and objects after each iteration of the solver, on the timeline `iteration`."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.result import RunResult
from objslam.output.plot.style import evenly, label_colours
from objslam.output.viewer.times import iteration_column

_PATH = (240, 140, 40)  # RGB: orange, unlike the colour of any path that stays.
_MAX_POINTS = 400  # The largest number of points of a path.
_MAX_STEPS = 400  # The largest number of iterations that are kept, evenly chosen.


def log_steps(recording: Any, result: RunResult) -> None:
    """`map/steps/path` and `map/steps/objects`, in the colours of their labels."""
    steps = [(r, i) for r in result.trace for i in r.iterations]
    if not steps:
        return
    numbers = evenly(len(steps), _MAX_STEPS)
    palette = {name: [round(255 * c) for c in rgb] for name, rgb in label_colours(result.map).items()}
    names = result.rays.label_names
    strips, positions, counts = [], [], []
    colours: list[list[int]] = []
    labels: list[str] = []
    for number in numbers.tolist():
        r, i = steps[number]
        strips.append(i.path[evenly(len(i.path), _MAX_POINTS)])
        placed = np.flatnonzero(np.isfinite(i.positions[:, 0]))
        positions.append(i.positions[placed])
        label = [names[k] for k in r.association.label[placed]]
        colours.extend(palette.get(name, [120, 120, 120]) for name in label)
        labels.extend(label)
        counts.append(len(placed))
    at = [iteration_column(numbers)]
    recording.send_columns("map/steps/path", at, rr.LineStrips3D.columns(strips=strips).partition(np.ones(len(strips), int)))
    line = rr.LineStrips3D.from_fields(colors=[_PATH], radii=rr.Radius.ui_points(2.5))
    recording.log("map/steps/path", line, static=True)
    points = rr.Points3D.columns(
        positions=np.concatenate(positions), colors=np.array(colours, dtype=np.uint8).reshape(-1, 3), labels=labels
    )
    recording.send_columns("map/steps/objects", at, points.partition(counts))
    dots = rr.Points3D.from_fields(radii=rr.Radius.ui_points(6), show_labels=False)
    recording.log("map/steps/objects", dots, static=True)
