"""Things that something without a box hides: what the heights of their boxes say about their place."""

from __future__ import annotations

import json

import numpy as np
import pytest

import objslam
from objslam.config import load_settings
from objslam.mapping.stages import described

FOCAL = 500.0
CAMERA = """image_width: 960
image_height: 480
camera_matrix: [500, 0, 480, 0, 500, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: [0, 0, 0, 0, 0]
base_T_camera:
  translation: [0.0, 0.0, 0.4]
  rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]
"""
BED = np.array([6.0, 0.0, 0.4])
"""The centre of a flat bed, 2 m wide and 0.8 m high, that faces the robot."""
CUPBOARD = np.array([1.9, 1.6, 0.5])
"""The centre of a cupboard beside the door, 0.5 m wide and 1 m high."""
DOOR, OPENING = 2.0, 0.5
"""Where the wall with the door is, and half the width of the opening, m."""


def drive(folder, *, door, table=0.0):
    """A robot that comes nearer and weaves. door: whether a wall hides what is not seen through its opening. table: m, how
    much of the lower part of the cupboard is hidden at most."""
    rng, count = np.random.default_rng(0), 160
    share = np.linspace(0, 1, count)
    path = np.column_stack([-4.0 + 4.5 * share, 0.8 * np.sin(9 * share)])
    folder.mkdir()
    (folder / "camera.yaml").write_text(CAMERA)
    poses = [f"{100 + 0.2 * k:.2f} {x:.4f} {y:.4f} 0 0 0 0 1" for k, (x, y) in enumerate(path.tolist())]
    (folder / "localization.txt").write_text("\n".join(poses) + "\n")
    lines = []
    for k, (x, y) in enumerate(path.tolist()):
        boxes = []
        for centre, half, tall in ((BED, 1.0, 0.4), (CUPBOARD, 0.25, 0.5)):
            ahead, sides = centre[0] - x, np.array([-half, half]) + centre[1]
            if door and centre is BED:
                sides = np.clip(sides, *(y + (np.array([-OPENING, OPENING]) - y) * ahead / (DOOR - x)))
            u = 480 - FOCAL * (sides[::-1] - y) / ahead
            hidden = table * (1 + np.sin(25 * k / count)) / 2 if centre is CUPBOARD else 0.0
            v = 240 - FOCAL * (centre[2] + np.array([tall, hidden - tall]) - 0.4) / ahead
            boxes.append((np.array([u[0], v[0], u[1], v[1]]) + rng.normal(0, 1, 4)).round(2).tolist())
        lines.append(
            json.dumps({"stamp": 100 + 0.2 * k, "boxes": boxes, "labels": ["bed", "cupboard"], "scores": [0.9, 0.9]})
        )
    (folder / "detections.jsonl").write_text("\n".join(lines) + "\n")
    return objslam.read(folder)


def mapped(log, mode):
    settings = load_settings(None, (f"mode={mode}", "checks.use=false", "output.recording=false"))
    return {one.label: one for one in objslam.run(log, settings).objects}


def squared(one, truth):
    """The squared Mahalanobis distance of a position."""
    off = one.position - truth
    return float(off @ np.linalg.solve(one.covariance, off))


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_the_sigma_of_a_thing_behind_a_door_reaches_to_the_thing(tmp_path, mode, monkeypatch):
    log = drive(tmp_path / "log", door=True)
    found = mapped(log, mode)
    monkeypatch.setattr(described, "with_box_heights", lambda objects, *_: objects)
    before = mapped(log, mode)
    assert np.linalg.norm(found["bed"].position - BED) > 1.0
    assert squared(before["bed"], BED) > 30.0
    assert squared(found["bed"], BED) < 7.8  # The 95 % quantile of chi-squared.
    np.testing.assert_array_equal(found["cupboard"].covariance, before["cupboard"].covariance)


def test_things_that_are_seen_whole_keep_their_sigma(tmp_path, monkeypatch):
    log = drive(tmp_path / "log", door=False)
    found = mapped(log, "fixed")
    monkeypatch.setattr(described, "with_box_heights", lambda objects, *_: objects)
    for label, one in mapped(log, "fixed").items():
        np.testing.assert_array_equal(found[label].covariance, one.covariance)
    assert squared(found["bed"], BED) < 7.8


def test_boxes_of_changing_height_are_less_sure(tmp_path, monkeypatch):
    """A table hides up to 0.5 m of the cupboard, more or less from place to place. The bed is seen whole."""
    log = drive(tmp_path / "log", door=False, table=0.5)
    found = mapped(log, "fixed")
    monkeypatch.setattr(described, "with_box_heights", lambda objects, *_: objects)
    before = mapped(log, "fixed")
    ratio = found["cupboard"].covariance / before["cupboard"].covariance
    assert (ratio > 1.3).all()
    assert np.ptp(ratio) < 1e-6 * ratio.max()
    np.testing.assert_array_equal(found["bed"].covariance, before["bed"].covariance)
