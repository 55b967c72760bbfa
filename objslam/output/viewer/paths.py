"""Paths and the robot that moves along them."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.arrays import Floats
from objslam.core.geometry import quaternion
from objslam.core.result import RunResult
from objslam.core.types import Trajectory, Truth
from objslam.output.plot.style import evenly
from objslam.output.viewer.times import stamp_column

_BEFORE, _AFTER, _TRUTH = (150, 150, 150), (40, 44, 52), (46, 139, 87)  # RGB: grey, nearly black, green.
_MAX_POINTS = 4000  # The largest number of points of one path: more cannot be told apart on a screen.


def log_paths(recording: Any, result: RunResult, truth: Truth | None) -> None:
    """`map/path/after` the estimation, `before` where that differs, and `truth` where it is known; static."""
    paths = {"after": (result.path_after, _AFTER, 2.0)}
    if not np.array_equal(result.path.poses, result.path_after.poses):
        paths["before"] = (result.path, _BEFORE, 1.0)
    if truth is not None and truth.trajectory is not None:
        paths["truth"] = (truth.trajectory, _TRUTH, 0.8)
    for name, (path, colour, width) in paths.items():
        strip = rr.LineStrips3D([thinned(path, _MAX_POINTS)], colors=[colour], radii=rr.Radius.ui_points(width))
        recording.log(f"map/path/{name}", strip, static=True)


def log_base(recording: Any, result: RunResult) -> None:
    """The robot's pose at each distinct stamp, as axes that move along the path: `map/base`."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    send_poses(recording, "map/base", stamps, result.map_T_base[first])
    recording.log("map/base", rr.TransformAxes3D(0.3), static=True)


def send_poses(recording: Any, entity: str, stamps: Floats, poses: Floats) -> None:
    """Move an entity: its poses (N, 4, 4) in map at stamps (N,), s."""
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternion(poses))
    recording.send_columns(entity, [stamp_column(stamps)], columns)


def thinned(path: Trajectory, most: int) -> Floats:
    """At most `most` positions (n, 3), m, of a path, evenly chosen, the first and the last among them."""
    return path.poses[evenly(len(path), most), :3, 3]
