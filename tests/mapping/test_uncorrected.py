"""The residuals with the shared errors left in: against closed forms of a turned camera and of a late clock."""

from __future__ import annotations

import numpy as np
import pytest
from added_errors import add_shared_errors
from scipy.spatial.transform import Rotation, Slerp

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory, rates
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

_HELD = tuple(
    f"calibration.{name}=0" for name in ("scale", "turn_scale", "turn_bias", "turn_per_m", "turn_slip", "range_scale")
)
_ANGLES = ("yaw", "tilt", "roll")


def run(errors, held):
    overrides = ("mode=joint", "poses.use=odometry", "association.method=by_label", "output.picture=false")
    overrides = (
        *overrides,
        "checks.use=false",
        "bodies.use=false",
    )  # The turn of a bearing to its body is no shared error.
    held = (*_HELD, *(f"calibration.{name}=0" for name in ("centre", *held)))
    log = add_shared_errors(simulate(preset("demo", frames=240, objects=8, classes=8), 1), errors)
    return pipeline.run(log, load_settings(None, (*overrides, *held)), Ledger())


def test_a_turned_camera_turns_its_rays():
    """On a sphere, the way from the ray as measured to its object differs from the turn by at most the residual after."""
    result = run({"front.yaw": 0.04}, ("clock", "tilt", "roll"))
    assert result.calibration is not None
    assert result.calibration.names == ("front.yaw",)
    turn = Rotation.from_rotvec([0, 0, result.calibration.values[0]])
    # A camera that is turned about the vertical axis of a planar robot turns its rays about the vertical axis of the map.
    as_measured = turn.inv().apply(result.directions)
    way = np.arccos(np.clip((as_measured * result.directions).sum(axis=1), -1, 1))
    held = np.isfinite(result.residual)
    tilted = 2e-4  # The solved path may leave the plane by this much, rad.
    assert (np.abs(result.residual_before - way)[held] <= result.residual[held] + tilted).all()
    assert np.median(result.residual_before[held]) > 3 * np.median(result.residual[held])
    steps = [step.parameters for one in result.trace for step in one.iterations if step.parameters is not None]
    assert steps
    assert steps[-1].names == result.calibration.names
    assert steps[-1].values == pytest.approx(result.calibration.values)


def test_a_late_clock_shows_the_object_from_where_the_robot_was():
    """The same by another interpolation of the solved path, at the stamps as they were measured."""
    result = run({"front.clock": 0.15}, _ANGLES)
    assert result.calibration is not None
    assert result.residual_before is not None
    path, camera = result.path_after, result.cameras[0].base_T_camera
    which = np.flatnonzero(np.isfinite(result.residual))
    stamps = result.keyframes.stamps[result.rays.keyframe[which]] - result.calibration.values[0]
    which, stamps = which[stamps >= path.stamps[0]], stamps[stamps >= path.stamps[0]]
    turned = Slerp(path.stamps, Rotation.from_matrix(path.poses[:, :3, :3]))(stamps)
    places = np.stack([np.interp(stamps, path.stamps, path.poses[:, i, 3]) for i in range(3)], axis=1)
    origin = places + turned.apply(camera[:3, 3])
    direction = turned.apply(result.rays.direction[which] @ camera[:3, :3].T)
    to = np.array([o.position for o in result.map.objects])[result.association.object[which]] - origin
    off = np.arctan2(np.linalg.norm(np.cross(to, direction), axis=1), (to * direction).sum(axis=1))
    difference = np.abs(result.residual_before[which] - off)
    assert np.median(difference) < 5e-4
    assert difference.max() < 4e-3  # Between keyframes the path is only interpolated.
    assert np.median(off) > 3 * np.median(result.residual[which])


def test_without_calibration_there_is_nothing_before():
    log = simulate(preset("demo", frames=300), 1)
    result = pipeline.run(log, load_settings(None, ("output.picture=false", "calibration.use=false")), Ledger())
    assert result.residual_before is None


def test_the_rates_of_a_circle():
    t = np.linspace(5, 15, 101)
    turn = -0.6
    circle = np.stack([2 * np.sin(turn * t), -2 * np.cos(turn * t), turn * t + np.pi * (turn < 0)], axis=1)
    path = Trajectory(t, lift_se2(circle))
    speed, rate = rates(path, np.array([4.0, 5.0, 9.97, 15.0]))
    # The twist between two poses of a circle is constant, and its length is the arc's.
    assert speed == pytest.approx([0.0, 1.2, 1.2, 1.2], abs=1e-6)
    assert rate == pytest.approx([0.0, turn, turn, turn], abs=1e-6)
    still = rates(Trajectory(t[:1], np.eye(4)[None]), np.array([5.0]))
    assert [a.tolist() for a in still] == [[0.0], [0.0]]
