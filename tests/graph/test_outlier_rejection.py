"""Stretches of a drive that are rejected as a whole: it is their poses that are wrong, not their rays."""

import numpy as np
from drives import ODOMETRY_ALONE, make_drive

from objslam.core.types import Association
from objslam.graph.outlier_rejection import JointSolution, rejected_stretches


def rejections(drive, rejected):
    used = np.ones(len(drive.rays), dtype=bool)
    used[rejected] = False
    return JointSolution(drive.keyframes.map_T_camera, drive.points, used, None, 0.0, 0)  # type: ignore[arg-type]


def test_a_stretch_is_what_is_rejected_with_its_neighbours():
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    alone, stretch = np.arange(0, 300, 7), np.arange(400, 430)
    found = rejected_stretches(drive.rays, drive.association, rejections(drive, np.concatenate([alone, stretch])))
    np.testing.assert_array_equal(np.flatnonzero(found), stretch[1:-1])  # at the ends half of the neighbours are fine
    few = rejected_stretches(drive.rays, drive.association, rejections(drive, np.arange(400, 404)))
    assert not few.any()
    at_the_start = rejected_stretches(drive.rays, drive.association, rejections(drive, np.arange(12)))
    np.testing.assert_array_equal(np.flatnonzero(at_the_start), np.arange(11))
    nobody = Association(
        np.where(np.isin(np.arange(len(drive.rays)), stretch), -1, drive.association.object), drive.association.label
    )
    assert not rejected_stretches(drive.rays, nobody, rejections(drive, stretch)).any()  # of no object: rejected by nobody
