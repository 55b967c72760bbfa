"""Lost in the woods: the first five minutes of a real robot whose three cameras share their stamps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lost_in_the_woods import read_lost_in_the_woods

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Detections
from objslam.evaluation.evaluate import INSIDE_95, evaluate
from objslam.mapping import pipeline
from objslam.mapping.checks.diagnosis import diagnose

SWEEP = 160 / 240 / 15  # s, from the right camera to the left: the laser turns through 240 degrees 15 times a second


@pytest.mark.parametrize("with_range", [False, True])
def test_posts_path_and_clocks(data_dir, with_range):
    """Every second observation, all settings at their defaults. Bearings alone leave the metre to the odometry."""
    log = read_lost_in_the_woods(data_dir / "lost_in_the_woods", seconds=300.0, every=2, with_range=with_range)
    ledger = Ledger()
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), ledger)
    assert ledger.warnings == []
    assert result.summary["rounds"] == []  # names tell the posts apart
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    found = evaluate(result.map, log.truth, path, align="se2", radius=2.0).to_dict()
    assert (found["matched"], found["missed"], found["false"], found["unresolved"]) == (17, 0, 0, 0)
    assert found["position_rmse"] <= (0.03 if with_range else 0.09)
    assert found["ate"] <= (0.05 if with_range else 0.1)
    assert as_the_map_says(result.map, found) >= 0.85
    # Without the errors that all posts share: they go with the alignment.
    assert found["inside_95"] >= 0.8
    scaled = evaluate(result.map, log.truth, path, align="sim2", radius=2.0).to_dict()
    assert scaled["position_rmse"] <= 0.03
    parameters = result.summary["calibration"]["parameters"]
    if not with_range:
        assert abs(scaled["transform"]["scale"] - 1) < 2 * parameters["odometry.scale"]["sigma"]
        assert not parameters["odometry.scale"]["observable"]
    # What nobody told the solve: the laser saw the posts to the right first.
    apart = parameters["left.clock"]["value"] - parameters["right.clock"]["value"]
    sigma = np.hypot(parameters["left.clock"]["sigma"], parameters["right.clock"]["sigma"])
    assert abs(apart - SWEEP) < 4 * sigma < 0.07
    assert apart > 0.02


def test_posts_without_names(data_dir):
    """All posts are called the same. The odometry drifts by 0.05 rad in 5 s, and the nearest posts are 1.3 m apart."""
    log = read_lost_in_the_woods(data_dir / "lost_in_the_woods", seconds=150.0)
    assert log.truth is not None
    cameras = tuple(replace(c, detections=without_names(c.detections)) for c in log.cameras)
    posts = tuple(replace(post, label="post") for post in log.truth.objects)
    log = replace(log, cameras=cameras, truth=replace(log.truth, objects=posts))
    lens = "calibration.centre=0"  # A laser has none.
    settings = load_settings(None, ("mode=joint", "output.recording=false", "checks.use=false", lens))
    result = pipeline.run(log, settings, Ledger())
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    found = evaluate(result.map, log.truth, path, align="se2", radius=0.3).to_dict()
    assert (found["matched"], found["missed"], found["false"]) == (17, 0, 0)
    assert found["position_rmse"] <= 0.036  # If the odometry changes by 1e-9 m, it is 0.029 to 0.035 m.
    assert found["ate"] <= 0.06


def as_the_map_says(objects: ObjectMap, found: dict[str, Any]) -> float:
    """The share of posts inside the 95 % ellipses of the map, which hold the errors that all posts share too."""
    yaw = np.radians(found["transform"]["yaw_deg"])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    offset = np.array([one["offset"][:2] for one in found["objects"]]) @ turn
    covariance = np.stack([objects.by_id(one["id"]).covariance[:2, :2] for one in found["objects"]])
    squared = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariance), offset)
    return float((squared <= INSIDE_95).mean())


def without_names(detections: Detections) -> Detections:
    return replace(detections, label=np.zeros_like(detections.label), label_names=("post",))


@pytest.mark.parametrize("seconds", [60.0, 180.0])
def test_a_start_with_cameras_that_are_turned_and_late_is_no_wrong_input(data_dir, seconds):
    """Most posts are seen from one direction only, which says nothing. Mirrored images would let their rays cross."""
    log = read_lost_in_the_woods(data_dir / "lost_in_the_woods", seconds=seconds)
    settings = load_settings(None, ("mode=joint", "output.recording=false"))
    assert not diagnose(log, settings, Ledger()).spoilt
    result = pipeline.run(log, settings, Ledger())
    assert result.summary["wrong_input"] == []
    assert len(result.map.resolved()) >= 7
