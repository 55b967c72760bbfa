"""Paths and the robot that moves along them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.geometry import quaternion
from objslam.types import Floats, Trajectory, Truth
from objslam.viewer.times import stamp_column

if TYPE_CHECKING:
    from objslam.results import RunResult

_BEFORE, _AFTER, _TRUTH = (150, 150, 150), (40, 44, 52), (46, 139, 87)
_MOST = 4000  # points of one path: more are not told apart on a screen


def log_paths(recording: Any, result: RunResult, truth: Truth | None) -> None:
    """`map/path/after` the estimation, `before` it where that is another, and the `truth` where it is known; static."""
    import rerun as rr

    paths = {"after": (result.path_after, _AFTER, 2.0)}
    if not np.array_equal(result.path.poses, result.path_after.poses):
        paths["before"] = (result.path, _BEFORE, 1.0)
    if truth is not None and truth.trajectory is not None:
        paths["truth"] = (truth.trajectory, _TRUTH, 0.8)
    for name, (path, colour, width) in paths.items():
        strip = rr.LineStrips3D([thinned(path, _MOST)], colors=[colour], radii=rr.Radius.ui_points(width))
        recording.log(f"map/path/{name}", strip, static=True)


def log_base(recording: Any, result: RunResult) -> None:
    """The robot's pose at each distinct stamp, as axes that move along the path: `map/base`."""
    import rerun as rr

    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    poses = result.map_T_base[first]
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternion(poses))
    recording.send_columns("map/base", [stamp_column(stamps)], columns)
    recording.log("map/base", rr.TransformAxes3D(0.3), static=True)


def thinned(path: Trajectory, most: int) -> Floats:
    """The places (n, 3) of a path, at most so many, evenly chosen, the first and the last among them."""
    if len(path) <= most:
        return path.poses[:, :3, 3]
    return path.poses[np.linspace(0, len(path) - 1, most).round().astype(np.int64), :3, 3]
