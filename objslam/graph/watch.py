"""What puts the iterations of a solver into the trace."""

from __future__ import annotations

import gtsam

from objslam.graph.optimise import Watch, read_poses, with_points
from objslam.trace import Trace
from objslam.types import Floats, Ints


def watch_solve(trace: Trace | None, positions: Floats, landmarks: Ints, fixed: Floats | None = None) -> Watch | None:
    """The watch on a solve of some landmarks (n,) among the positions (N, 3); fixed: camera poses that are not solved."""
    if trace is None:
        return None

    def watch(cost: float, values: gtsam.Values) -> None:
        poses = read_poses(values) if fixed is None else fixed
        trace.iteration("solve", cost, poses, with_points(positions, landmarks, values))

    return watch
