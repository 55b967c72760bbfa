"""The usual errors of the place of a camera on its robot, and what a map says about them."""

from dataclasses import replace

import numpy as np
import pytest
from quick import ROUGH

from objslam.config import Odometry, Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.frontend.known_errors import USUAL_PLACE, prior_sigma, usual_place
from objslam.mapping import pipeline
from objslam.mapping.checks.small_errors import SmallErrors
from objslam.simulation import preset, simulate

BESIDE = 0.02


@pytest.fixture(scope="module")
def drive():
    """A drive with a localisation and with odometry, both in the plane."""
    return simulate(preset("demo", frames=120, classes=12, odometry=Odometry()), 3)


def in_space(path):
    """A path that also rises and sinks."""
    poses = path.poses.copy()
    poses[:, 2, 3] = np.sin(path.stamps)
    return Trajectory(path.stamps, poses)


@pytest.mark.parametrize(
    ("mode", "localized", "odometry", "planar", "level", "height"),
    [
        ("fixed", True, True, True, USUAL_PLACE, USUAL_PLACE),
        ("joint", True, False, False, USUAL_PLACE, USUAL_PLACE),
        ("joint", True, True, True, BESIDE, USUAL_PLACE),
        ("joint", True, True, False, BESIDE, BESIDE),
        ("joint", False, True, True, 0.0, 0.0),
        ("joint", False, True, False, 0.0, 0.0),
    ],
)
def test_the_place_is_as_sure_as_the_poses_can_hide_its_error(drive, mode, localized, odometry, planar, level, height):
    log = replace(
        drive, localization=drive.localization if localized else None, odometry=drive.odometry if odometry else None
    )
    if not planar:
        log = replace(
            log,
            localization=None if log.localization is None else in_space(log.localization),
            odometry=None if log.odometry is None else in_space(log.odometry),
        )
    settings = load_settings(None, (f"mode={mode}",))
    place = usual_place(log, settings)
    assert [prior_sigma(f"front.{axis}", settings, place) for axis in "xyz"] == [level, level, height]
    assert (prior_sigma("front.focal", settings, place) > 0) == (level > 0)


def test_heights_of_a_joint_map_allow_for_a_camera_that_is_higher_than_the_log_says(drive):
    camera = drive.cameras[0].camera
    mount = camera.base_T_camera.copy()
    mount[2, 3] += 0.06
    log = replace(drive, cameras=(replace(drive.cameras[0], camera=replace(camera, base_T_camera=mount)),))
    rough = [one for one in ROUGH if "noise" not in one]
    result = pipeline.run(log, load_settings(None, ("mode=joint", *rough)), Ledger())
    true = {one.label: one.position for one in drive.truth.objects}
    found = result.map.resolved()
    assert len(found) >= 0.9 * len(true)
    off = np.array([one.position[2] - true[one.label][2] for one in found])
    sigma = np.array([np.sqrt(one.covariance[2, 2]) for one in found])
    assert np.abs(np.median(off) - 0.06) < 0.02
    assert (np.abs(off) < 2 * sigma).all()
    assert np.median(sigma) < 0.08


def test_a_camera_far_from_its_place_is_unusual():
    names = ("front.x", "front.y", "front.yaw")
    found = SmallErrors(None, names, np.array([0.25, 0.15, 0.01]), np.full(3, 0.01), frozenset(names))
    words = found.unusual(Settings(mode="fixed"))
    assert "front.x" in words
    assert "front.y" not in words
    assert "yaw" not in words
