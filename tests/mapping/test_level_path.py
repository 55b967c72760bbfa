"""From planar odometry alone, a camera that tilts while the robot starts does not tilt the map."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.mapping.localization import PriorMap
from objslam.simulation import preset, simulate

CHANGES = ("output.recording=false", "poses.use=odometry", "mode=joint", "checks.use=false")
PITCH = 0.03  # rad, by which the camera looks up while the robot starts


def drive(pitch: float) -> Log:
    """A drive whose camera is on a mast: it first looks up by `pitch`, rad, and comes down within seconds. So its first
    boxes are too low."""
    log = simulate(preset("demo", false=0.0, frames=250), 3)
    (camera,) = log.cameras
    found = camera.detections
    lower = camera.camera.matrix[1, 1] * pitch * np.exp(-(found.stamps - found.frame_stamps.min()) / 4.0)
    boxes = found.boxes + lower[:, None] * np.array([0.0, 1.0, 0.0, 1.0])
    return replace(log, cameras=(replace(camera, detections=replace(found, boxes=boxes)),))


def mapped(log: Log) -> RunResult:
    return pipeline.run(log, load_settings(None, CHANGES), Ledger())


def slope(result: RunResult, other: RunResult) -> float:
    """How much the objects of one map rise against those of the other, in rad."""
    here, there = (np.array([o.position for o in one.map.resolved()]) for one in (result, other))
    apart = np.linalg.norm(here[:, None, :2] - there[None, :, :2], axis=2)
    place = there[apart.argmin(axis=1)][apart.min(axis=1) < 0.3]
    rise = here[apart.min(axis=1) < 0.3][:, 2] - place[:, 2]
    across: Floats = np.column_stack([place[:, :2], np.ones(len(place))])
    return float(np.linalg.norm(np.linalg.lstsq(across, rise, rcond=None)[0][:2]))


def test_a_tilt_at_the_start_does_not_tilt_the_map() -> None:
    level, tilted = mapped(drive(0.0)), mapped(drive(PITCH))
    assert len(tilted.map.resolved()) >= 10
    assert slope(tilted, level) < PITCH / 20
    up = tilted.map_T_base[:, :3, 2].mean(axis=0)
    assert up / np.linalg.norm(up) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    origins, directions = tilted.rays.in_map(tilted.map_T_base @ tilted.keyframes.base_T_camera)
    assert tilted.origins == pytest.approx(origins)
    assert tilted.directions == pytest.approx(directions)
    assert np.nanmedian(tilted.residual) < np.radians(0.5)  # Rays still meet at their objects.


def test_a_drive_that_is_not_in_the_older_map_is_level_too() -> None:
    log = drive(PITCH)
    settings = load_settings(None, (*CHANGES, "bodies.use=false"))
    elsewhere = pipeline.run(simulate(preset("demo", frames=100), 5), load_settings(None, CHANGES), Ledger())
    result = pipeline.run(log, settings, Ledger(), known=PriorMap("elsewhere", elsewhere.map))
    assert not result.summary["localisation"]["localised"]
    up = result.map_T_base[:, :3, 2].mean(axis=0)
    assert up / np.linalg.norm(up) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
