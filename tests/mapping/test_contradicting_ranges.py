"""Ranges that contradict the rays of an object, in a drive past two things that are seen from one side."""

from __future__ import annotations

import json

import numpy as np
import pytest
from waiting import LIMIT

import objslam
from objslam.config import load_settings
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session

FOCAL, HALF = 500.0, 0.15
CAMERA = """image_width: 640
image_height: 480
camera_matrix: [500, 0, 320, 0, 500, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: [0, 0, 0, 0, 0]
base_T_camera:
  translation: [0.0, 0.0, 0.4]
  rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]
"""
THINGS = {"fridge": (4.0, 0.5, 0.6), "oven": (4.0, -0.5, 0.6)}
"""Where the rays of each thing cross, m."""


def log_with_depths(folder, behind):
    """A folder with a robot that moves 1.2 m sideways. behind: m by label, how far the depths end behind the crossing."""
    rng, steps = np.random.default_rng(0), np.linspace(-0.6, 0.6, 60)
    folder.mkdir()
    (folder / "camera.yaml").write_text(CAMERA)
    poses = [f"{100 + 0.2 * k:.2f} 0 {y:.4f} 0 0 0 0 1" for k, y in enumerate(steps)]
    (folder / "localization.txt").write_text("\n".join(poses) + "\n")
    lines = []
    for k, y in enumerate(steps):
        boxes, depths = [], []
        for label, (ahead, aside, height) in THINGS.items():
            u, v = 320 - FOCAL * (aside - y) / ahead, 240 - FOCAL * (height - 0.4) / ahead
            half = FOCAL * HALF / ahead
            boxes.append((np.array([u - half, v - half, u + half, v + half]) + rng.normal(0, 1, 4)).round(2).tolist())
            depths.append(round(ahead + behind.get(label, 0.0) - 0.5 * HALF + rng.normal(0, 0.05), 3))
        frame = {"stamp": 100 + 0.2 * k, "boxes": boxes, "labels": list(THINGS), "scores": [0.9] * 2, "depths": depths}
        lines.append(json.dumps(frame))
    (folder / "detections.jsonl").write_text("\n".join(lines) + "\n")
    return objslam.read(folder)


def sigma_ahead(one):
    """The standard deviation (m) of a thing along the view."""
    return float(np.sqrt(one.covariance[0, 0]))


def test_an_object_has_a_sigma_that_reaches_to_its_ranges(tmp_path):
    """The rays of the fridge cross 0.9 m before its ranges end. The joint solve places it between the two."""
    settings = load_settings(None, ("mode=joint", "calibration.use=false", "checks.use=false", "output.recording=false"))
    usual = objslam.run(log_with_depths(tmp_path / "usual", {}), settings).objects
    found = objslam.run(log_with_depths(tmp_path / "other", {"fridge": 0.9}), settings).objects
    by_label = {one.label: one for one in found}
    ahead = by_label["fridge"].position[0]
    assert 4.3 < ahead < 4.7
    assert sigma_ahead(by_label["fridge"]) == pytest.approx(4.9 - ahead, abs=0.15)
    assert all(sigma_ahead(one) < 0.1 for one in usual)
    assert sigma_ahead(by_label["oven"]) < 0.2


def test_a_session_ends_with_the_same_sigma(tmp_path):
    settings = load_settings(None, ("mode=joint", "calibration.use=false", "checks.use=false", "output.recording=false"))
    log = log_with_depths(tmp_path / "log", {"fridge": 0.9})
    session = Session(settings, patient=True).start()
    session.push_camera(log.cameras[0].camera)
    for _, frame, one in events(log):
        one(session)
        assert not frame or session.wait(LIMIT), session.failure
    by_label = {one.label: one for one in session.stop().map.objects}
    assert sigma_ahead(by_label["fridge"]) == pytest.approx(4.9 - by_label["fridge"].position[0], abs=0.15)
    assert sigma_ahead(by_label["oven"]) < 0.2
