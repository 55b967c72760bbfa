"""Compute the motions by odometry between the poses of a result, for exports and other optimisers."""

from dataclasses import replace

import numpy as np

from objslam.core.result import RunResult
from objslam.io.odometry_parquet import Motions

_TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def motions_of(result: RunResult) -> Motions | None:
    """Return the motions by odometry between the poses of trajectory.txt, or None if the run used no odometry, as in fixed
    mode.

    Their covariances (6, 6) have the translation (m) first, then the rotation (rad).
    """
    from objslam.graph.factors.odometry import motions

    keyframes = result.keyframes
    if keyframes.odom_T_base is None:
        return None
    stamps, first = np.unique(keyframes.stamps, return_index=True)
    at = keyframes.take(first)
    at = replace(at, base_T_camera=np.broadcast_to(np.eye(4), at.base_T_camera.shape))
    motion, covariance = motions(at, result.settings)
    swapped = covariance[:, _TRANSLATION_FIRST][:, :, _TRANSLATION_FIRST]
    there = at.measured
    return Motions(stamps[:-1][there], stamps[1:][there], motion[there], swapped[there])
