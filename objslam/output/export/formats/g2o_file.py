"""g2o: the poses and the odometry between them as a pose graph, for g2o, GTSAM, Ceres and SE-Sync."""

from __future__ import annotations

from typing import TYPE_CHECKING

from objslam.errors import OutputError
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.output.export.content import Content


def _dump(content: Content) -> bytes:
    """The pose graph as text.

    Vertices are map_T_base of trajectory.txt, and the first of each stretch is fixed. Edges are what the odometry measured.
    An information matrix is that of x, y, z (m) and the rotation about x, y, z (rad), in the frame of the edge's second
    pose, as GTSAM reads it.
    """
    import numpy as np

    motions, path = content.motions, content.path
    if motions is None:
        raise OutputError(
            "no edges: motions.parquet is missing, which only a joint run with odometry writes",
            where=str(content.out),
            hint="--mode joint, and a log with odometry that poses.use does not leave out",
        )
    before = np.minimum(np.searchsorted(path.stamps, motions.before), max(len(path) - 2, 0))
    if not (np.array_equal(path.stamps[before], motions.before) and np.array_equal(path.stamps[before + 1], motions.after)):
        raise OutputError("trajectory.txt and motions.parquet are not of one run", where=str(content.out))
    information = np.linalg.inv(motions.covariance)[:, *np.triu_indices(6)]
    lines = [f"VERTEX_SE3:QUAT {i} {numbers}" for i, numbers in enumerate(_numbers(_components(path.poses)))]
    lines += [f"FIX {i}" for i in np.setdiff1d(np.arange(len(path)), before + 1).tolist()]
    edges = np.hstack([_components(motions.motion), information])
    lines += [f"EDGE_SE3:QUAT {i} {i + 1} {numbers}" for i, numbers in zip(before.tolist(), _numbers(edges), strict=True)]
    return ("\n".join(lines) + "\n").encode()


def _components(poses: Floats) -> Floats:
    """x, y, z and the quaternion (x, y, z, w), (N, 7), of poses (N, 4, 4)."""
    import numpy as np

    from objslam.core.geometry import quaternion

    return np.hstack([poses[:, :3, 3], quaternion(poses)])


def _numbers(rows: Floats) -> list[str]:
    return [" ".join(map(repr, row)) for row in rows.tolist()]


EXPORT = ExportFormat("g2o", "graph.g2o", "poses and odometry, for other optimisers", _dump)
