"""Parts of logs that are cut anywhere, also where little is left: each is mapped, or refused with a clear error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_log import small_log

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.errors import LogError, SolveError
from objslam.frontend.log_part import part_of_log
from objslam.mapping import pipeline
from objslam.simulation import make_camera

CAMERAS = (
    make_camera("left", focal=380.0, position=(0.0, 0.0, 0.3), yaw=np.pi / 2),
    make_camera("front", focal=380.0, position=(0.1, 0.0, 0.3)),
)


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    """Three drives: with two cameras, with odometry alone, and with a camera that moves on the robot."""
    two, plain = small_log(1, cameras=CAMERAS, frames=20), small_log(0, frames=20)
    path, first = plain.robot_path, plain.cameras[0]
    assert path is not None
    mount = Trajectory(path.stamps[::5], np.tile(first.camera.base_T_camera, (len(path.stamps[::5]), 1, 1)))
    return [two, replace(plain, localization=None), replace(plain, cameras=(replace(first, mount=mount),))]


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_any_part_of_a_log_is_mapped_or_refused(logs: list[Log], which: int, mode: str) -> None:
    """Also where the odometry ends earlier than the rest."""
    log, ends = logs[which], list[bool]()
    path = log.robot_path
    assert path is not None
    chance, span = np.random.default_rng(which), path.stamps[-1] - path.stamps[0]
    settings = load_settings(None, (f"mode={mode}",))
    for share in (0.001, 0.1, 0.3, 1.0):
        begin = path.stamps[0] + chance.uniform(-0.1, 1.0 - share) * span
        try:
            part = part_of_log(log, begin, begin + share * span)
            if part.odometry is not None:
                half = slice(0, len(part.odometry) // 2 + 1)
                shorter = replace(part.odometry, stamps=part.odometry.stamps[half], poses=part.odometry.poses[half])
                part = replace(part, odometry=replace(shorter, travel=None))
            objects = pipeline.run(part, settings, Ledger()).map.resolved()
            ends.append(all(np.isfinite(o.position).all() and np.isfinite(o.covariance).all() for o in objects))
        except (LogError, SolveError):
            pass
    assert ends
    assert all(ends)
