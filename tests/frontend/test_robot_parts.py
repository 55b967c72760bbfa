"""Boxes of a part of the robot stay at one place of the image. Boxes of things at rest stay in the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from more_boxes import with_boxes
from robot_arm import ARM, with_arm
from turning_drive import BASE_T_CAMERA, drive

from objslam.association.observations import overlap
from objslam.config import load_settings
from objslam.core.camera import Camera, project, undistort
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse, lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.boxes.part_finder import RobotPartFinder
from objslam.frontend.boxes.robot_parts import ROBOT_PARTS, without_robot_parts
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

SETTINGS = load_settings(None, ("output.recording=false",))


def arms(log: Log) -> np.ndarray:
    """The boxes of the arm, by their places."""
    found = log.cameras[0].detections
    assert found is not None
    return np.flatnonzero(overlap(ARM, found.boxes) > 0.7)


def dropped(log: Log, settings=SETTINGS) -> tuple[Log, int]:
    """The log without parts of the robot, and the number of their boxes in the ledger."""
    ledger = Ledger()
    return without_robot_parts(log, settings, ledger), ledger.dropped.get(ROBOT_PARTS, 0)


def looking(path: np.ndarray, seconds: float, things: np.ndarray, yaw: float = 0.0, half_size: float = 0.15) -> Log:
    """A drive along a path (N, 3) of x, y, yaw, with a camera turned by `yaw` and square boxes around things (T, 3)."""
    stamps = np.linspace(0.0, seconds, len(path))
    mount = make_pose(lift_se2(np.array([0.0, 0.0, yaw]))[:3, :3] @ BASE_T_CAMERA[:3, :3], BASE_T_CAMERA[:3, 3])
    camera = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), base_T_camera=mount)
    poses = lift_se2(path)
    rng = np.random.default_rng(0)
    boxes, frames = [], []
    for frame, pose in enumerate(poses @ mount):
        local = (things - pose[:3, 3]) @ inverse(pose)[:3, :3].T
        for at in local[local[:, 2] > 0.5]:
            middle, half = project(camera, at[None])[0], half_size * 500.0 / at[2]
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
    ledger = Ledger()
    left = without_robot_parts(log, SETTINGS, ledger)
    number = ledger.dropped[ROBOT_PARTS]
    assert ledger.totals[ROBOT_PARTS] == len(log.cameras[0].detections)
    assert ledger.examples[ROBOT_PARTS] == [
        f"camera front, stamp {log.cameras[0].detections.stamps[arms(log)[0]]:.3f}, label {label}"
    ]
    before, after = clean.cameras[0].detections, left.cameras[0].detections
    assert before is not None
    assert after is not None
    assert number == len(log.cameras[0].detections) - len(before) > 100
    np.testing.assert_array_equal(after.boxes, before.boxes)
    assert dropped(clean)[1] == 0
    assert dropped(log, load_settings(None, ("rays.robot_parts=false",)))[1] == 0


def test_an_arm_is_found_among_thousands_of_boxes_of_its_label():
    """More boxes than are counted at once. Most are at random places of the image."""
    rng = np.random.default_rng(0)
    clean = drive()
    low = rng.uniform(0, [560, 400], (6000, 2))
    frames = np.sort(rng.integers(0, len(clean.cameras[0].detections.frame_stamps), 6000))
    log = with_boxes(clean, frames, np.hstack([low, low + rng.uniform(20, 70, (6000, 2))]), "arm")
    crowd = with_arm(log, "arm", share=1.0)
    assert dropped(log)[1] == 0
    assert dropped(crowd)[1] == pytest.approx(len(crowd.cameras[0].detections) - len(log.cameras[0].detections), abs=10)


def test_a_camera_on_an_arm_keeps_its_boxes():
    log = with_arm(drive(), "arm")
    stamps = np.array([0.0, 60.0])
    moving = replace(log.cameras[0], mount=Trajectory(stamps, np.stack([BASE_T_CAMERA] * 2)))
    assert dropped(replace(log, cameras=(moving,)))[1] == 0


def circling() -> Log:
    """The camera looks at a thing in the middle of a circle all the time."""
    turn = np.linspace(0, 4 * np.pi, 300)
    circle = np.column_stack([2 * np.cos(turn), 2 * np.sin(turn), turn + np.pi])
    return looking(circle, 60.0, np.array([[0.0, 0.0, 0.5]]))


def after_a_wait() -> Log:
    """A robot waits before a thing, and then turns on the spot."""
    still = np.zeros((100, 3))
    still[:, 2] = np.random.default_rng(0).normal(0, 0.01, 100)
    turn = np.linspace(0, 4 * np.pi, 80)
    return looking(np.concatenate([still, np.column_stack([0 * turn, 0 * turn, turn])]), 60.0, np.array([[2.0, 0.0, 0.5]]))


def turning_slowly() -> Log:
    """A robot turns on the spot to and fro, so slowly that a thing moves by a fifth of a pixel from frame to frame."""
    turn = 0.5 * np.abs((np.arange(6000) * 0.0004 + 0.5) % 2 - 1) * 2 - 0.5
    return looking(np.column_stack([0 * turn - 2.0, 0 * turn - 3.0, turn + np.pi]), 200.0, np.array([[-6.0, -3.0, 0.5]]))


def past_a_row() -> Log:
    """A robot passes a dense row of equal things to and fro."""
    row = np.column_stack([np.arange(-4, 4, 0.35), np.full(23, 2.0), np.full(23, 0.5)])
    turn = np.linspace(0, 60, 400)
    path = np.column_stack([1.5 * np.sin(0.2 * turn), 0.3 * np.cos(0.3 * turn), np.pi / 2 + 0.5 * np.sin(0.7 * turn)])
    return looking(path, 60.0, row)


def between_rows() -> Log:
    """A robot drives to and fro between two rows of large equal things, and looks along them. One thing after another is at
    the same place of the image."""
    row = np.arange(0.0, 14.0, 2.2)
    things = np.column_stack([np.tile(row, 2), np.repeat([-3.0, 3.0], len(row)), np.full(2 * len(row), 0.45)])
    along, turn = np.linspace(-2.0, 15.0, 110), np.linspace(0, np.pi, 20)
    there = np.column_stack([along, 0.3 * np.sin(0.5 * along), 0.15 * np.cos(0.5 * along)])
    back = np.column_stack([along[::-1], -0.3 * np.sin(0.5 * along[::-1]), np.pi + 0.15 * np.cos(0.5 * along[::-1])])
    ends = [np.column_stack([0 * turn + x, 0 * turn, turn + first]) for x, first in ((15.0, 0.0), (-2.0, np.pi))]
    return looking(np.concatenate([there, ends[0], back, ends[1]] * 3), 160.0, things, half_size=0.6)


def circling_two() -> Log:
    """The robot drives three times around one thing, and then three times around another one."""
    turn = np.linspace(0, 6 * np.pi, 300)
    circle = np.column_stack([2 * np.cos(turn), 2 * np.sin(turn), turn + np.pi])
    return looking(
        np.concatenate([circle, circle + np.array([9.0, 0.0, 0.0])]), 120.0, np.array([[0.0, 0.0, 0.5], [9.0, 0.0, 0.5]])
    )


def on_curves(frames: int) -> tuple[Log, np.ndarray]:
    """A robot drives left and right on curves of changing radii. Its camera looks to its left side, and each second image
    shows a part of the robot. Also the boxes of this part."""
    rng = np.random.default_rng(0)
    seconds = np.linspace(0.0, 60.0, frames)
    yaw = np.cumsum(1.2 * np.sin(0.9 * seconds) + 0.6 * np.sin(0.37 * seconds)) * 60.0 / frames
    way = 0.5 * 60.0 / frames
    path = np.column_stack([way * np.cumsum(np.cos(yaw)), way * np.cumsum(np.sin(yaw)), yaw])
    clean = looking(path, 60.0, rng.uniform([-6, -6, 0.2], [6, 6, 1.0], (30, 3)), yaw=np.pi / 2)
    shown = np.arange(0, len(path), 2)
    part = np.array([280.0, 300, 350, 360]) + rng.normal(0, 1.5, (len(shown), 4))
    return with_boxes(clean, shown, part, "part"), part


@pytest.mark.parametrize("frames", [600, 120])
def test_a_part_beside_a_camera_that_looks_to_the_side_is_dropped(frames):
    """On a left curve, the rays of the part meet in the middle of the curve, as if the robot drove around a thing. With 2
    images a second, few windows have more than two boxes of the part."""
    log, part = on_curves(frames)
    label = log.cameras[0].detections.label_names.index("part")
    left, number = dropped(log)
    assert number > 0.95 * len(part)
    assert (left.cameras[0].detections.label == label).sum() == len(part) - number
    assert found_online(log)[0].sum() > 0.5 * len(part)


def test_two_things_that_a_robot_drives_around_stay():
    log = circling_two()
    assert len(log.cameras[0].detections.boxes) > 580
    assert dropped(log)[1] == 0


def test_a_thing_in_the_middle_of_a_circle_stays():
    """It stays at one place of the image, but its rays meet."""
    log = circling()
    assert len(log.cameras[0].detections.boxes) > 290
    assert np.ptp(log.cameras[0].detections.boxes, axis=0).max() < 15
    assert dropped(log)[1] == 0


def test_a_thing_before_a_robot_that_waits_stays():
    assert dropped(after_a_wait())[1] == 0


def test_a_row_of_equal_things_stays():
    """Some of the boxes are at each place of the image in nearly each frame, but as many are beside it."""
    log = past_a_row()
    assert len(log.cameras[0].detections.boxes) > 2000
    assert dropped(log)[1] == 0


def test_rows_of_equal_things_beside_a_corridor_stay():
    log = between_rows()
    assert len(log.cameras[0].detections.boxes) > 2000
    assert dropped(log)[1] == 0


def found_online(log: Log) -> tuple[np.ndarray, RobotPartFinder]:
    """Which boxes of a log a session would drop, and its finder."""
    found, camera = log.cameras[0].detections, log.cameras[0].camera
    assert found is not None
    path = log.odometry
    poses = interpolate(path.stamps, path.poses, found.frame_stamps, 10.0)[0] @ camera.base_T_camera
    direction = undistort(camera, (found.boxes[:, :2] + found.boxes[:, 2:]) / 2)[0]
    finder, part = RobotPartFinder(), []
    for frame, pose in enumerate(poses):
        mine = found.frame == frame
        part.append(finder.add(found.boxes[mine], found.label[mine], pose, direction[mine]))
    return np.concatenate(part), finder


def test_a_session_finds_the_arm_while_it_drives():
    clean = drive()
    log = with_arm(clean, "thing_3")
    found = log.cameras[0].detections
    assert found is not None
    _, left = dropped(log)
    arm = np.isin(np.arange(len(found)), arms(log))
    assert arm.sum() == left  # None of the things has a box there.
    part, finder = found_online(log)
    assert (part <= arm).all()
    first = int(np.flatnonzero(part)[0])
    assert found.stamps[first] - found.stamps[0] < 20
    assert part[first:].sum() > 0.98 * arm[first:].sum()  # A noisy box of the arm may overlap by less than 0.7.
    np.testing.assert_array_equal(
        finder.are_parts(found.boxes, found.label) & arm, finder.are_parts(found.boxes, found.label)
    )
    assert finder.are_parts(found.boxes, found.label).sum() > 0.95 * arm.sum()
    assert not found_online(clean)[0].any()


def test_a_session_forgets_an_arm_that_has_moved_away():
    log = with_arm(drive(), "arm")
    found, (_, finder) = log.cameras[0].detections, found_online(log)
    assert found is not None
    arm = found.label_names.index("arm")
    box, label, ahead = ARM[None], np.array([arm]), np.array([[0.0, 0.0, 1.0]])
    assert finder.are_parts(box, label).all()
    elsewhere = ARM[None] - 150.0
    for _ in range(502):
        assert not finder.add(elsewhere, label, np.eye(4), ahead).any()
    assert not finder.add(box, label, np.eye(4), ahead).any()


@pytest.mark.parametrize(
    "log",
    [circling(), circling_two(), past_a_row(), after_a_wait(), turning_slowly(), between_rows()],
    ids=["circle", "two", "row", "wait", "slow", "rows"],
)
def test_a_session_keeps_boxes_of_things_at_rest(log):
    part, finder = found_online(log)
    assert not part.any()
    assert not finder.are_parts(log.cameras[0].detections.boxes, log.cameras[0].detections.label).any()


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
