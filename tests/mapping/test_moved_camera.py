"""A camera that somebody turns in the middle of a log is told from errors that last: clock, lens, place and rotation."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from added_errors import add_shared_errors
from scipy.spatial.transform import Rotation

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.types import Log
from objslam.mapping.checks.diagnosis import diagnose
from objslam.simulation import preset, simulate

PRIORS = {"clock": 0.1, "roll": 0.02, "tilt": 0.02, "yaw": 0.03, "focal": 0.02, "cx": 0.02, "cy": 0.02}
PRIORS |= {"x": 0.05, "y": 0.05, "z": 0.05}


@cache
def drive(seed: int) -> Log:
    """A drive with localisation, and usual errors of its camera."""
    rng = np.random.default_rng(1000 + seed)
    errors = {f"front.{what}": sigma * rng.standard_normal() for what, sigma in PRIORS.items()}
    return add_shared_errors(simulate(preset("demo", objects=12, classes=12, frames=200), seed), errors)


def turned(log: Log, axis: int, degrees: float) -> Log:
    """The log with the boxes of the second half where a camera would see them that is turned about an axis of base."""
    one = log.cameras[0]
    found, camera = one.detections, one.camera
    base_R_camera = camera.base_T_camera[:3, :3]
    turn = base_R_camera.T @ Rotation.from_rotvec(np.radians(-degrees) * np.eye(3)[axis]).as_matrix() @ base_R_camera
    middle = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2
    seen = np.column_stack([middle, np.ones(len(middle))]) @ np.linalg.inv(camera.matrix).T @ turn.T @ camera.matrix.T
    late = found.frame >= len(found.frame_stamps) // 2
    shift = np.where(late[:, None], seen[:, :2] / seen[:, 2:] - middle, 0.0)
    return replace(log, cameras=(replace(one, detections=replace(found, boxes=found.boxes + np.tile(shift, 2))),))


def said(log: Log) -> list[str]:
    return [finding.message for finding in diagnose(log, load_settings(None, ("mode=fixed",)), Ledger()).findings]


@pytest.mark.parametrize("seed", [1, 12, 18, 50])
def test_usual_errors_of_a_camera_are_no_fault(seed):
    """A late clock turns all rays to the left where the robot turns right, and to the right where it turns left."""
    assert said(drive(seed)) == []


@pytest.mark.parametrize(("axis", "name"), [(0, "roll"), (1, "tilt"), (2, "yaw")])
@pytest.mark.parametrize("seed", [3])
def test_a_turn_is_found_beside_usual_errors(seed, axis, name):
    (message,) = said(turned(drive(seed), axis, 6.0))
    found = re.match(rf"front\.{name} changes by (\S+) deg between the halves of the log", message)
    assert found, message
    assert float(found[1]) == pytest.approx(6.0, abs=1.5)


def test_errors_of_poses_that_last_for_seconds_are_no_turn() -> None:
    """A localisation errs by 6 cm and 1.1 degrees, newly every 3 s. All boxes of these seconds share the error, so the boxes
    seem to show a turn of 3.3 degrees."""
    rng = np.random.default_rng(16)
    log = simulate(preset("demo", objects=8, classes=8, frames=400), 16)
    assert log.truth is not None
    assert log.truth.trajectory is not None
    path = log.truth.trajectory
    white = rng.normal(size=(len(path), 3)) * [0.001, 0.001, 0.0003]
    piece = ((path.stamps - path.stamps[0]) // 3).astype(int)
    errors = lift_se2(rng.normal(size=(piece.max() + 1, 3))[piece] * [0.06, 0.06, 0.02] + white)
    poses = path.poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ errors[:, :3, :3]
    poses[:, :3, 3] += errors[:, :3, 3]
    log = replace(log, localization=replace(path, poses=poses), odometry=None)
    assert not any("moved the camera" in message for message in said(log))
