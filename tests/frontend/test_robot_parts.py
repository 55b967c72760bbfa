"""Boxes of a part of the robot stay at one place of the image. Boxes of things at rest stay in the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_drive import BASE_T_CAMERA, drive

from objslam.config import load_settings
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse, lift_se2, make_pose
from objslam.core.types import CameraLog, Detections, Log, Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.robot_parts import ROBOT_PARTS, without_robot_parts
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("output.recording=false",))
ARM = np.array([210.0, 330.0, 290.0, 400.0])


def with_boxes(log: Log, label: str, boxes: np.ndarray, frames: np.ndarray) -> Log:
    """The log with more boxes (M, 4) of a label in these frames (M,) of its only camera."""
    found = log.cameras[0].detections
    assert found is not None
    names = found.label_names if label in found.label_names else (*found.label_names, label)
    order = np.argsort(np.concatenate([found.frame, frames]), kind="stable")

    def joined(one: np.ndarray, more: object) -> np.ndarray:
        return np.concatenate([one, np.broadcast_to(more, (len(frames), *one.shape[1:]))])[order]

    more = replace(
        found,
        frame=joined(found.frame, frames),
        boxes=joined(found.boxes, boxes),
        label=joined(found.label, names.index(label)),
        scores=joined(found.scores, 0.9),
        depths=joined(found.depths, np.nan),
        track_ids=joined(found.track_ids, -1),
        label_names=names,
    )
    return replace(log, cameras=(replace(log.cameras[0], detections=more),))


def with_arm(log: Log, label: str, share: float = 0.5) -> Log:
    """The log with boxes of the robot's arm, in this share of the frames, with 1.5 px of noise."""
    rng = np.random.default_rng(1)
    found = log.cameras[0].detections
    assert found is not None
    frames = np.flatnonzero(rng.random(len(found.frame_stamps)) < share)
    return with_boxes(log, label, ARM + rng.normal(0, 1.5, (len(frames), 4)), frames)


def dropped(log: Log, settings=SETTINGS) -> tuple[Log, int]:
    """The log without parts of the robot, and the number of their boxes in the ledger."""
    ledger = Ledger()
    return without_robot_parts(log, settings, ledger), ledger.dropped.get(ROBOT_PARTS, 0)


def looking(path: np.ndarray, seconds: float, things: np.ndarray, yaw: float = 0.0) -> Log:
    """A drive along a path (N, 3) of x, y, yaw, with a camera turned by `yaw` and boxes of 0.3 m around things (T, 3)."""
    stamps = np.linspace(0.0, seconds, len(path))
    mount = make_pose(lift_se2(np.array([0.0, 0.0, yaw]))[:3, :3] @ BASE_T_CAMERA[:3, :3], BASE_T_CAMERA[:3, 3])
    camera = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), base_T_camera=mount)
    poses = lift_se2(path)
    rng = np.random.default_rng(0)
    boxes, frames = [], []
    for frame, pose in enumerate(poses @ mount):
        local = (things - pose[:3, 3]) @ inverse(pose)[:3, :3].T
        for at in local[local[:, 2] > 0.5]:
            middle, half = project(camera, at[None])[0], 0.15 * 500.0 / at[2]
            box = np.concatenate([middle - half, middle + half]) + rng.normal(0, 1.5, 4)
            if (box[:2] > 1).all() and (box[2:] < [638, 478]).all():
                boxes.append(box)
                frames.append(frame)
    m = len(frames)
    none = np.zeros(m, dtype=np.int64)
    columns = np.array(frames), np.array(boxes), none, np.full(m, 0.9), np.full(m, np.nan), none - 1
    return Log("looking", (CameraLog(camera, Detections(stamps, *columns, ("thing",))),), odometry=Trajectory(stamps, poses))


@pytest.mark.parametrize("label", ["arm", "thing_3"])
def test_boxes_of_an_arm_are_dropped_and_counted(label):
    clean = drive()
    log = with_arm(clean, label)
    left, number = dropped(log)
    before, after = clean.cameras[0].detections, left.cameras[0].detections
    assert before is not None
    assert after is not None
    assert number == len(log.cameras[0].detections) - len(before) > 100
    np.testing.assert_array_equal(after.boxes, before.boxes)
    assert dropped(clean)[1] == 0
    assert dropped(log, load_settings(None, ("rays.robot_parts=false",)))[1] == 0


def test_a_camera_on_an_arm_keeps_its_boxes():
    log = with_arm(drive(), "arm")
    stamps = np.array([0.0, 60.0])
    moving = replace(log.cameras[0], mount=Trajectory(stamps, np.stack([BASE_T_CAMERA] * 2)))
    assert dropped(replace(log, cameras=(moving,)))[1] == 0


def test_a_thing_in_the_middle_of_a_circle_stays():
    """The camera looks at it all the time, so it stays at one place of the image, but its rays meet."""
    turn = np.linspace(0, 4 * np.pi, 300)
    circle = np.column_stack([2 * np.cos(turn), 2 * np.sin(turn), turn + np.pi])
    log = looking(circle, 60.0, np.array([[0.0, 0.0, 0.5]]))
    assert len(log.cameras[0].detections.boxes) > 290
    assert np.ptp(log.cameras[0].detections.boxes, axis=0).max() < 15
    assert dropped(log)[1] == 0


def test_a_thing_before_a_robot_that_waits_stays():
    still = np.zeros((100, 3))
    still[:, 2] = np.random.default_rng(0).normal(0, 0.01, 100)
    turn = np.linspace(0, 4 * np.pi, 80)
    log = looking(np.concatenate([still, np.column_stack([0 * turn, 0 * turn, turn])]), 60.0, np.array([[2.0, 0.0, 0.5]]))
    assert dropped(log)[1] == 0


def test_a_row_of_equal_things_stays():
    """Some of the boxes are at each place of the image in nearly each frame, but as many are beside it."""
    row = np.column_stack([np.arange(-4, 4, 0.35), np.full(23, 2.0), np.full(23, 0.5)])
    turn = np.linspace(0, 60, 400)
    path = np.column_stack([1.5 * np.sin(0.2 * turn), 0.3 * np.cos(0.3 * turn), np.pi / 2 + 0.5 * np.sin(0.7 * turn)])
    log = looking(path, 60.0, row)
    assert len(log.cameras[0].detections.boxes) > 2000
    assert dropped(log)[1] == 0


def test_a_run_without_the_boxes_of_an_arm_has_the_map_of_the_drive():
    clean = simulate(preset("demo", frames=150), 3)
    log = with_arm(clean, clean.cameras[0].detections.label_names[0])
    ledger = Ledger()
    result = pipeline.run(log, SETTINGS, ledger)
    assert ledger.dropped[ROBOT_PARTS] > 50
    assert result.summary["counts"]["detections"] == len(log.cameras[0].detections)
    want = pipeline.run(clean, SETTINGS, Ledger())
    assert [o.label for o in result.map.objects] == [o.label for o in want.map.objects]
    np.testing.assert_allclose(result.map.positions, want.map.positions, atol=1e-9)
    assert not evaluate(result.map, log.truth).objects.false
