"""The estimation step by step: path and objects after each iteration of the solver, on the timeline `iteration`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.scene import label_colours
from objslam.viewer.times import iteration_column

if TYPE_CHECKING:
    from objslam.results import RunResult

_PATH = (240, 140, 40)
_MOST_POINTS = 400  # of a path
_MOST = 400  # iterations: of more, evenly many are left out


def log_steps(recording: Any, result: RunResult) -> None:
    """`map/steps/path` and `map/steps/objects`, in the colours of their labels."""
    import rerun as rr

    steps = [(r, i) for r in result.trace for i in r.iterations]
    if not steps:
        return
    numbers = np.unique(np.linspace(0, len(steps) - 1, min(len(steps), _MOST)).round().astype(np.int64))
    palette = {name: [round(255 * c) for c in rgb] for name, rgb in label_colours(result.map).items()}
    names = result.rays.label_names
    strips, positions, counts = [], [], []
    colours: list[list[int]] = []
    labels: list[str] = []
    for number in numbers.tolist():
        r, i = steps[number]
        some = np.linspace(0, max(len(i.path) - 1, 0), min(len(i.path), _MOST_POINTS)).round().astype(np.int64)
        strips.append(i.path[some])
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
