"""g2o: the poses and the odometry between them as a pose graph, for g2o, GTSAM, Ceres and SE-Sync."""

from __future__ import annotations

import numpy as np

from objslam.errors import OutputError
from objslam.export.content import Content
from objslam.geometry import quaternion
from objslam.types import Floats

_UPPER = np.triu_indices(6)


def dump(content: Content) -> bytes:
    """Vertices are map_T_base of trajectory.txt, edges what the odometry measured; the first pose is fixed.

    Information matrices are those of x, y, z (m) and the rotation about x, y, z (rad), in the frame of the edge's second
    pose, as GTSAM reads them. OutputError where the run used no odometry, as in fixed mode, or its poses and motions do not
    fit together.
    """
    motions, path = content.motions, content.path
    if motions is None:
        raise OutputError(
            "no edges: motions.parquet is missing, which only a joint run with odometry writes",
            where=str(content.out),
            hint="--mode joint, and a log with odometry that poses.use does not leave out",
        )
    if not (np.array_equal(motions.before, path.stamps[:-1]) and np.array_equal(motions.after, path.stamps[1:])):
        raise OutputError("trajectory.txt and motions.parquet are not of one run", where=str(content.out))
    information = np.linalg.inv(motions.covariance)[:, *_UPPER]
    lines = [f"VERTEX_SE3:QUAT {i} {numbers}" for i, numbers in enumerate(_numbers(_components(path.poses)))]
    lines.append("FIX 0")
    edges = np.hstack([_components(motions.motion), information])
    lines += [f"EDGE_SE3:QUAT {i} {i + 1} {numbers}" for i, numbers in enumerate(_numbers(edges))]
    return ("\n".join(lines) + "\n").encode()


def _components(poses: Floats) -> Floats:
    """x, y, z and the quaternion (x, y, z, w), (N, 7), of poses (N, 4, 4)."""
    return np.hstack([poses[:, :3, 3], quaternion(poses)])


def _numbers(rows: Floats) -> list[str]:
    return [" ".join(map(repr, row)) for row in rows.tolist()]
