"""The clocks of cameras from turns alone, on simulated drives whose clocks are wrong by a known offset."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objslam.config import load_settings
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.types import CameraLog, Detections, Log, Trajectory
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.shared_errors import SharedErrors, shared_errors
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.simulation.shared_errors import add_shared_errors

BASE_T_CAMERA = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.0, 0.5]))


def drive(seed: int = 1, turns: float = 0.8, clock: float = 0.0, false: float = 0.0) -> Log:
    """A robot that looks to and fro (by `turns`, rad) while it drives, past objects of which some are out of view.

    clock: s, what the stamps of the camera lack. false: the share of boxes with a wrong label.
    """
    rng = np.random.default_rng(seed)
    at = np.arange(0.0, 60.0, 0.05)
    heading = turns * (np.sin(0.9 * at) + 0.5 * np.sin(1.7 * at + 1))
    path = np.column_stack([0.2 * at, np.zeros_like(at), heading])
    stamps = np.arange(1.0, 59.0, 0.2)
    poses = lift_se2(np.column_stack([np.interp(stamps, at, column) for column in path.T]))
    places = np.column_stack([rng.uniform(0, 16, 40), rng.uniform(-4, 4, 40), rng.uniform(0, 1, 40)])
    camera = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), base_T_camera=BASE_T_CAMERA)
    map_T_camera = poses @ BASE_T_CAMERA
    local = np.einsum("kji,knj->kni", map_T_camera[:, :3, :3], places - map_T_camera[:, None, :3, 3])
    with np.errstate(all="ignore"):
        pixels = project(camera, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    frame, label = np.nonzero((local[..., 2] > 0.5) & ((pixels > 20) & (pixels < [619, 459])).all(axis=2))
    centre = pixels[frame, label] + rng.normal(size=(len(frame), 2))
    wrong = rng.random(len(frame)) < false
    detections = Detections(
        frame_stamps=stamps - clock,
        frame=frame,
        boxes=np.concatenate([centre - 8, centre + 8], axis=1),
        label=np.where(wrong, rng.integers(0, 40, len(frame)), label),
        scores=np.ones(len(frame)),
        depths=np.full(len(frame), np.nan),
        track_ids=np.full(len(frame), -1),
        label_names=tuple(f"thing_{i}" for i in range(40)),
    )
    return Log("turning", (CameraLog(camera, detections),), odometry=Trajectory(at, lift_se2(path)))


def errors_of(log: Log, *overrides: str) -> SharedErrors:
    settings, ledger = load_settings(None, ("mode=joint", *overrides)), Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    found = shared_errors(log, keyframes, build_rays(log, keyframes, settings, ledger), settings)
    assert found is not None
    return found


def clock_of(errors: SharedErrors, theta: np.ndarray) -> float:
    return float(theta[errors.names.index("front.clock")])


@pytest.mark.parametrize("clock", [-0.24, 0.1, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_turns_show_the_clock(clock, seed):
    errors = errors_of(drive(seed, clock=clock))
    theta = clocks_of_turns(errors)
    assert clock_of(errors, theta) == pytest.approx(clock, abs=0.06)
    others = [i for i, name in enumerate(errors.names) if name != "front.clock"]
    np.testing.assert_array_equal(theta[others], errors.mean[others])


def test_wrong_labels_and_other_shared_errors_do_not_hide_the_clock():
    wrong = {"front.yaw": 0.05, "odometry.turn_scale": 0.08, "odometry.turn_bias": 0.003}
    log = add_shared_errors(drive(3, clock=0.2, false=0.1), wrong)
    errors = errors_of(log)
    assert clock_of(errors, clocks_of_turns(errors)) == pytest.approx(0.2, abs=0.06)


def test_the_axes_of_base_and_of_the_odometry_do_not_matter():
    """The base of a visual odometry may have the axes of a camera, and its world those of the first image."""
    log = drive(2, clock=0.16)
    odometry, camera = log.odometry, log.cameras[0]
    other_T_base, world_T_odom = (make_pose(Rotation.random(rng=seed).as_matrix(), np.zeros(3)) for seed in (1, 2))
    poses = world_T_odom @ odometry.poses @ inverse(other_T_base)
    mounted = replace(camera, camera=replace(camera.camera, base_T_camera=other_T_base @ camera.camera.base_T_camera))
    errors = errors_of(replace(log, odometry=Trajectory(odometry.stamps, poses), cameras=(mounted,)))
    assert clock_of(errors, clocks_of_turns(errors)) == pytest.approx(0.16, abs=0.06)


def test_a_robot_that_does_not_turn_shows_no_clock():
    errors = errors_of(drive(1, turns=0.0, clock=0.3))
    np.testing.assert_array_equal(clocks_of_turns(errors), errors.mean)


def test_a_clock_that_is_held_stays():
    errors = errors_of(drive(clock=0.2), "calibration.clock=0")
    assert "front.clock" not in errors.names
    np.testing.assert_array_equal(clocks_of_turns(errors), errors.mean)


def test_no_offset_beyond_the_largest_is_found():
    errors = errors_of(drive(clock=0.4), "calibration.max_clock=0.2")
    assert abs(clock_of(errors, clocks_of_turns(errors))) <= 0.2 + 1e-9
