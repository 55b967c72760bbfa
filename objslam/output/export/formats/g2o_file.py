"""The g2o format: poses and odometry as a pose graph, for g2o, GTSAM, Ceres and SE-Sync."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from objslam.errors import OutputError
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.output.export.content import Content


def _dump(content: Content) -> bytes:
    """Return the pose graph as text.

    Each map_T_base of trajectory.txt is a vertex, and each odometry measurement is an edge. The first vertex of each
    connected part is fixed. The information matrix of an edge has the order x, y, z (m), then rotation about x, y, z (rad),
    in the frame of the second pose, as GTSAM reads it.
    """
    import numpy as np

    from objslam.io.results.read import refuse_site

    refuse_site(content.out, "path")
    motions, path = content.motions, content.path
    if motions is None:
        raise OutputError(
            "motions.parquet is missing: only a joint run with odometry writes it",
            where=str(content.out),
            hint="run again with --mode joint, and let poses.use include the log's odometry",
        )
    if len(path) < 2 and len(motions.before):
        raise OutputError("trajectory.txt and motions.parquet are from different runs: run again", where=str(content.out))
    before = np.minimum(np.searchsorted(path.stamps, motions.before), max(len(path) - 2, 0))
    if not (np.array_equal(path.stamps[before], motions.before) and np.array_equal(path.stamps[before + 1], motions.after)):
        raise OutputError("trajectory.txt and motions.parquet are from different runs: run again", where=str(content.out))
    try:
        information = np.linalg.inv(motions.covariance)[:, *np.triu_indices(6)]
    except np.linalg.LinAlgError as error:
        raise OutputError("motions.parquet has a covariance without an inverse", where=str(content.out)) from error
    if not np.isfinite(information).all():
        raise OutputError("motions.parquet has a covariance without an inverse", where=str(content.out))
    lines = [f"VERTEX_SE3:QUAT {i} {numbers}" for i, numbers in enumerate(_numbers(path.poses))]
    lines += [f"FIX {i}" for i in np.setdiff1d(np.arange(len(path)), before + 1).tolist()]
    edges = zip(before.tolist(), _numbers(motions.motion, information), strict=True)
    lines += [f"EDGE_SE3:QUAT {i} {i + 1} {numbers}" for i, numbers in edges]
    return ("\n".join(lines) + "\n").encode()


def _numbers(poses: Floats, *more: Any) -> list[str]:
    """Return a text for each pose (N, 4, 4): x, y, z, the quaternion (x, y, z, w), and the row of each array in `more`."""
    import numpy as np

    from objslam.core.geometry import quaternion

    return [" ".join(map(repr, row)) for row in np.hstack([poses[:, :3, 3], quaternion(poses), *more]).tolist()]


EXPORT = ExportFormat("g2o", "graph.g2o", "poses and odometry, for other optimisers", _dump)
