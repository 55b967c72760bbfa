"""The noise of given poses that a log shows: against what was drawn, and the map with it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.mapping import pipeline
from objslam.mapping.fixed.pose_noise import noise_in_frames
from objslam.simulation import PoseNoise, pair, preset, simulate

FIXED = Settings(mode="fixed")
QUIET = ("output.recording=false", "output.picture=false", "bodies.use=false")


def drive(xy: float, yaw: float, seed: int = 0, **changes: object) -> Log:
    """A drive whose poses are drawn at the stamps of the images, so no interpolation makes their noise smaller."""
    noise = {"localization": PoseNoise(xy=xy, yaw=yaw), "localization_rate": None, "odometry": None}
    return simulate(preset("demo", **{**noise, "false": 0.0, **changes}), seed)


def found_in(log: Log, objects: slice = slice(None)) -> tuple[float, float]:
    """The factors at the true places of the objects, each with a label of its own, from the rays that agree on a place."""
    frames = build_keyframes(log, FIXED, Ledger())
    rays = build_rays(log, frames, FIXED, Ledger())
    association = associate_by_label(rays)
    weight = triangulate_at(frames.map_T_camera, frames, rays, association, FIXED).weight
    association = replace(association, object=np.where(weight > 0, association.object, -1))
    true = {item.label: item.position for item in log.truth.objects}
    places = np.full((association.count, 3), np.nan)
    places[objects] = np.array([true[rays.label_names[label]] for label in association.label])[objects]
    return noise_in_frames(frames, rays, association, places, FIXED)


@pytest.mark.parametrize(("xy", "yaw"), [(0.06, 0.05), (0.02, 0.05), (0.1, 0.005)])
@pytest.mark.parametrize("pixels", [2.0, 8.0])
def test_the_drawn_noise_is_found_whatever_the_noise_of_boxes(xy, yaw, pixels):
    heading, place = found_in(drive(xy, yaw, classes=12, pixel_sigma=pixels))
    # At 3 m, the two errors of a ray are alike. Only precise boxes tell them apart.
    assert np.hypot(0.005 * heading, 0.02 * place / 3.0) == pytest.approx(np.hypot(yaw, xy / 3.0), rel=0.25)
    if pixels == 2.0:
        assert 0.005 * heading == pytest.approx(yaw, rel=0.25, abs=0.004)
        assert 0.02 * place == pytest.approx(xy, rel=0.25, abs=0.015)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("xy", "yaw", "pixels"), [(0.02, 0.005, 3.0), (0.02, 0.005, 9.0), (0.001, 0.001, 3.0)])
def test_poses_as_good_as_said_keep_the_noise_of_the_settings(xy, yaw, pixels, seed):
    assert found_in(drive(xy, yaw, seed, classes=12, pixel_sigma=pixels)) == (1.0, 1.0)


def test_a_frame_with_one_object_does_not_tell_poses_from_boxes():
    log = drive(0.06, 0.05, classes=12)
    assert found_in(log)[0] > 5
    assert found_in(log, slice(0, 1)) == (1.0, 1.0)


def test_false_boxes_and_wrong_labels_are_no_noise_of_poses():
    log = drive(0.02, 0.005, classes=12, false=0.3)
    found = log.cameras[0].detections
    label, rng = found.label.copy(), np.random.default_rng(0)
    wrong = rng.random(len(label)) < 0.15
    label[wrong] = rng.integers(12, size=wrong.sum())
    mixed = replace(log, cameras=(replace(log.cameras[0], detections=replace(found, label=label)),))
    assert found_in(mixed) == (1.0, 1.0)


@cache
def noisy(*told: str) -> tuple[Log, RunResult, Ledger]:
    """A drive with noisy poses, its map, and what the run warned of."""
    log, ledger = drive(0.06, 0.05, 1, objects=8, classes=2, frames=250), Ledger()
    return log, pipeline.run(log, load_settings(None, ("mode=fixed", *QUIET, *told)), ledger), ledger


@pytest.mark.parametrize("calibration", ["auto", "false"])
def test_noisy_poses_do_not_split_objects(calibration):
    told = () if calibration == "auto" else ("calibration.use=false",)
    log, result, _ = noisy(*told)
    objects = result.map.resolved()
    assert len(objects) == 8
    for item in log.truth.objects:
        (near,) = [o for o in objects if o.label == item.label and np.linalg.norm(o.position - item.position) < 0.4]
        off = near.position - item.position
        assert off @ np.linalg.solve(near.covariance, off) < 16.3  # 99.9 %, 3 degrees of freedom
    noise = result.summary["noise"]
    across = np.hypot(0.005 * noise["heading"], 0.02 * noise["place"] / 3.0)  # The error of a ray at 3 m, which sums both.
    assert across == pytest.approx(np.hypot(0.05, 0.06 / 3.0), rel=0.35)
    if calibration == "false":  # Else the priors of the camera's errors give gates wide enough for this drive.
        _, plain, _ = noisy(*told, "noise.localization=false")
        assert len(plain.map.resolved()) > 8


def test_the_verdict_names_the_noise_of_the_poses():
    _, result, ledger = noisy()
    assert result.summary["assessment"]["level"] == "check"
    assert "localisation noise" in result.summary["assessment"]["reasons"][0]
    assert any("localization.yaw and localization.xy say" in line for line in ledger.warnings)


def test_two_things_beside_each_other_stay_two_at_good_poses():
    log = simulate(pair(0.2, odometry=None, localization=PoseNoise(xy=0.02, yaw=0.005), pixel_sigma=2.0), 0)
    for calibration in ("auto", "false"):
        result = pipeline.run(log, load_settings(None, (f"calibration.use={calibration}", *QUIET)), Ledger())
        assert len(result.map.resolved()) == 2
        assert result.summary["noise"] is None
