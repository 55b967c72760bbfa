"""Growing the graph along the path: a start near the truth where the odometry alone is far from it."""

from dataclasses import replace

import numpy as np
import pytest
from drives import ODOMETRY_ALONE, make_drive

from objslam.core.geometry import inverse, lift_se2
from objslam.core.types import Keyframes
from objslam.graph.assembly import Measurements
from objslam.graph.init_known_correspondences import initialize_known

ROUGH = {"x_per_m": 0.04, "y_per_m": 0.01, "yaw_per_m": 0.05, "yaw_per_rad": 0.1}
TOLD = [f"odometry.{name}={value}" for name, value in ROUGH.items()]


def grown(drive, progress=lambda done, total: None):
    measured = Measurements.of(drive.keyframes, drive.rays, drive.settings)
    return initialize_known(measured, drive.association, progress)


def path_of(drive, map_T_camera):
    return map_T_camera @ inverse(drive.keyframes.base_T_camera)


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_a_rough_odometry_grows_to_the_truth(seed):
    drive = make_drive(seed, "mode=joint", *TOLD, frames=300, localization=None, odometry=ROUGH)
    map_T_camera, positions = grown(drive)
    assert np.isfinite(positions).all()
    assert drive.object_errors(positions, "se2").max() < 0.15
    assert drive.ate(path_of(drive, map_T_camera)) < 0.25 * drive.ate(drive.keyframes.map_T_base)
    np.testing.assert_allclose(map_T_camera[0], drive.keyframes.map_T_camera[0], atol=1e-3)  # where the map begins


def test_progress_comes_in_keyframes_and_steps_grow_while_predictions_hold():
    drive = make_drive(0, "mode=joint", "joint.grow_step=10", false=0.0, **ODOMETRY_ALONE)
    told = []
    grown(drive, lambda done, total: told.append((done, total)))
    done, total = np.array(told).T
    assert (total == len(drive.keyframes)).all()
    assert done[-1] == len(drive.keyframes)
    assert (np.diff(done) > 0).all()
    assert np.diff(done)[:2].tolist() == [20, 40]


def test_a_step_that_surprises_is_taken_back_and_made_shorter():
    """A turn that the odometry did not notice: what comes next is predicted far beside where it is seen."""
    drive = make_drive(0, "mode=joint", "joint.grow_step=20", false=0.0, **ODOMETRY_ALONE)
    keyframes = drive.keyframes
    at = 60
    turn = keyframes.odom_T_base[at] @ lift_se2(np.array([0.0, 0, np.radians(40)])) @ inverse(keyframes.odom_T_base[at])
    kicked = kick(keyframes, at, turn)
    told = []
    map_T_camera, _ = grown(replace(drive, keyframes=kicked), lambda done, total: told.append(done))
    steps = np.diff(told)
    assert steps.min() <= 5  # a quarter of grow_step
    told.clear()
    grown(drive, lambda done, total: told.append(done))
    assert np.diff(told)[:-1].min() >= 20  # without the kick there was no reason to
    before = path_of(drive, map_T_camera)[:at]
    assert np.linalg.norm((before - drive.map_T_base[:at])[:, :2, 3], axis=1).max() < 0.3


def kick(keyframes: Keyframes, at: int, turn) -> Keyframes:
    """The odometry turned about where it was at a keyframe, from there on."""
    odom = keyframes.odom_T_base.copy()
    odom[at:] = turn @ odom[at:]
    return replace(keyframes, odom_T_base=odom, map_T_base=keyframes.map_T_base[0] @ inverse(odom[0]) @ odom)


def test_landmarks_that_their_rays_do_not_carry_have_no_place():
    drive = make_drive(0, "mode=joint", false=0.0, **ODOMETRY_ALONE)
    owner = drive.association.object
    few = np.flatnonzero(owner == 2)[3:]  # three rays are too few to agree on anything
    keep = np.setdiff1d(np.arange(len(owner)), few)
    lone = replace(drive, rays=drive.rays.take(keep), association=replace(drive.association, object=owner[keep]))
    _, positions = grown(lone)
    assert np.isnan(positions[2]).all()
    assert np.isfinite(np.delete(positions, 2, axis=0)).all()


def test_false_boxes_do_not_pull_the_path_away():
    for seed in range(4):
        drive = make_drive(seed, "mode=joint", false=0.1, **ODOMETRY_ALONE)
        assert drive.right().mean() < 0.67
        map_T_camera, positions = grown(drive)
        assert drive.ate(path_of(drive, map_T_camera)) < 0.5 * drive.ate(drive.keyframes.map_T_base)
        assert np.nanmedian(drive.object_errors(positions, "se2")) < 0.15


def test_no_landmark_leaves_the_odometry_as_it_is():
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    nobody = replace(drive.association, object=np.full(len(drive.rays), -1))
    map_T_camera, positions = grown(replace(drive, association=nobody))
    np.testing.assert_allclose(map_T_camera, drive.keyframes.map_T_camera, atol=1e-9)
    assert np.isnan(positions).all()


def test_one_keyframe():
    drive = make_drive(0, "mode=joint", **ODOMETRY_ALONE)
    first = drive.rays.keyframe == 0
    one = replace(
        drive,
        keyframes=drive.keyframes.take(np.array([0])),
        rays=drive.rays.take(first),
        association=replace(drive.association, object=drive.association.object[first]),
    )
    map_T_camera, positions = grown(one)
    np.testing.assert_array_equal(map_T_camera, one.keyframes.map_T_camera)
    assert np.isnan(positions).all()
