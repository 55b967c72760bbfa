"""How well the boxes of several logs agree, measured together."""

from dataclasses import replace

import numpy as np

from objslam.config import load_settings
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.mapping.checks.agreement import Agreement, agreement, agreements, bounded_part
from objslam.mapping.checks.hypotheses.every import hypotheses, later
from objslam.simulation import preset, simulate
from objslam.simulation.settings import make_camera

TURN = lift_se2(np.array([0.0, 0.0, 1.0]))


def turned(log: Log, number: int) -> Log:
    """The log with one of its cameras turned."""
    cameras = list(log.cameras)
    camera = cameras[number].camera
    cameras[number] = replace(cameras[number], camera=replace(camera, base_T_camera=TURN @ camera.base_T_camera))
    return replace(log, cameras=tuple(cameras))


def moving(log: Log) -> Log:
    """The log with a first camera that turns on the robot."""
    one = log.cameras[0]
    stamps = one.detections.frame_stamps
    turns = lift_se2(np.column_stack([np.zeros((len(stamps), 2)), np.linspace(0.0, 1.0, len(stamps))]))
    mount = Trajectory(stamps, turns @ one.camera.base_T_camera)
    return replace(log, cameras=(replace(one, mount=mount), *log.cameras[1:]))


def same(one: Agreement, other: Agreement) -> None:
    """Tables of several logs add up their numbers in another order."""
    np.testing.assert_allclose([one.share, one.score], [other.share, other.score], atol=1e-9)
    np.testing.assert_allclose(one.points, other.points, atol=1e-6)
    np.testing.assert_allclose(one.fit, other.fit, atol=1e-6)
    np.testing.assert_array_equal(one.keyframes.base_T_camera, other.keyframes.base_T_camera)
    assert one.keyframes.overlap == other.keyframes.overlap


def test_each_log_agrees_as_if_it_were_alone():
    """What logs have in common is computed once: mounts differ alone, or with clocks, boxes, paths or moving cameras."""
    back = make_pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    front = make_camera()
    cameras = front, replace(front, name="back", base_T_camera=back @ front.base_T_camera)
    log = simulate(preset("demo", objects=8, classes=8, frames=80, cameras=cameras), 0)
    settings = load_settings(None, ("mode=fixed",))
    part = bounded_part(log, settings)
    log = part.log
    nobody = replace(log, localization=Trajectory(log.localization.stamps + 1e6, log.localization.poses))
    logs = [log, turned(log, 0), turned(log, 1), moving(log), turned(moving(log), 1), nobody, turned(nobody, 0)]
    logs += [later(turned(log, 1), 0.5), turned(later(log, 0.5), 0), turned(log, 0)]
    logs += [one.put_right(log) for one in hypotheses(log)]
    together = list(agreements(part, logs, settings))
    assert [one is None for one in together] == [one is nobody or one.localization is nobody.localization for one in logs]
    scores = {one.score for one in together if one is not None}
    assert len(scores) > len(logs) / 2  # the logs do differ
    for found, one in zip(together, logs, strict=True):
        if found is not None:
            same(found, agreement(part, one, settings))
