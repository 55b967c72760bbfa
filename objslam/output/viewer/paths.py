"""Log paths, the robot on its path, and the estimate after each iteration of the solver to a recording."""

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.arrays import Floats
from objslam.core.geometry import quaternion
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth
from objslam.output.plot.style import evenly, label_colours
from objslam.output.viewer.times import iteration_column, stamp_column

_BEFORE, _AFTER, _TRUTH = (150, 150, 150), (40, 44, 52), (46, 139, 87)  # The RGB colours are grey, nearly black, green.
_STEP = (240, 140, 40)  # The colour of the path of an iteration (RGB): orange, unlike the static paths.
_MAX_POINTS = 4000  # The largest number of points of a static path. A screen cannot resolve more points.
_MAX_STEP_POINTS = 400  # The largest number of points of the path of an iteration.
_MAX_STEPS = 400  # The largest number of iterations in a recording, evenly chosen.


def log_paths(recording: Any, result: RunResult, truth: Truth | None) -> None:
    """Log static paths in `map/path`: `after` the estimation, `before` it if the path differs, `truth` if it is known."""
    paths = {"after": (result.path_after, _AFTER, 2.0)}
    if not np.array_equal(result.path.poses, result.path_after.poses):
        paths["before"] = (result.path, _BEFORE, 1.0)
    if truth is not None and truth.trajectory is not None:
        paths["truth"] = (truth.trajectory, _TRUTH, 0.8)
    for name, (path, colour, width) in paths.items():
        strip = rr.LineStrips3D([thinned(path, _MAX_POINTS)], colors=[colour], radii=rr.Radius.ui_points(width))
        recording.log(f"map/path/{name}", strip, static=True)


def log_base(recording: Any, result: RunResult) -> None:
    """Log the robot's pose at each distinct stamp as moving axes, `map/base`."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    send_poses(recording, "map/base", stamps, result.map_T_base[first])
    recording.log("map/base", rr.TransformAxes3D(0.3), static=True)


def send_poses(recording: Any, entity: str, stamps: Floats, poses: Floats) -> None:
    """Send the poses (N, 4, 4), in map, of a moving entity at the stamps (N,), s."""
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternion(poses))
    recording.send_columns(entity, [stamp_column(stamps)], columns)


def thinned(path: Trajectory, most: int) -> Floats:
    """Return at most `most` positions (n, 3), m, of a path, evenly chosen, with the first and the last."""
    return path.poses[evenly(len(path), most), :3, 3]


def log_steps(recording: Any, result: RunResult) -> None:
    """Log the path, `map/steps/path`, and the objects, `map/steps/objects`, after each iteration of the solver."""
    steps = [(r, i) for r in result.trace for i in r.iterations]
    if not steps:
        return
    numbers = evenly(len(steps), _MAX_STEPS)
    palette = {name: [round(255 * c) for c in rgb] for name, rgb in label_colours(result.map).items()}
    strips, positions, counts = [], [], []
    labels: list[str] = []
    for number in numbers.tolist():
        r, i = steps[number]
        strips.append(i.path[evenly(len(i.path), _MAX_STEP_POINTS)])
        placed = np.flatnonzero(np.isfinite(i.positions[:, 0]))
        positions.append(i.positions[placed])
        labels += [result.rays.label_names[k] for k in r.association.label[placed]]
        counts.append(len(placed))
    colours = np.array([palette.get(name, [120, 120, 120]) for name in labels], dtype=np.uint8).reshape(-1, 3)
    at = [iteration_column(numbers)]
    recording.send_columns("map/steps/path", at, rr.LineStrips3D.columns(strips=strips).partition(np.ones(len(strips), int)))
    line = rr.LineStrips3D.from_fields(colors=[_STEP], radii=rr.Radius.ui_points(2.5))
    recording.log("map/steps/path", line, static=True)
    points = rr.Points3D.columns(positions=np.concatenate(positions), colors=colours, labels=labels)
    recording.send_columns("map/steps/objects", at, points.partition(counts))
    dots = rr.Points3D.from_fields(radii=rr.Radius.ui_points(6), show_labels=False)
    recording.log("map/steps/objects", dots, static=True)
