"""Rows of equal things, such as those on a shelf, seen from the side. The camera's prior is wider than the gaps."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log
from objslam.mapping import pipeline
from objslam.simulation import make_camera

COLUMNS, GAP, AWAY = 9, 0.2, 1.0
"""The things of each of three levels, the distance between neighbours, and that of the shelf from the path, m.

A map that is off by a whole gap misses a ninth of the things, which is more than the tests allow."""


def shelf(yaw: float = 0.0, pixels: float = 0.5, *, noisy: bool = False) -> tuple[Log, np.ndarray]:
    """A drive along a shelf and, further away, back in reverse, at known poses, and the places (N, 3) m of its things.

    Each level has its own label. yaw: rad, the error of the mount. noisy: whether the poses err as the settings say. Then
    four posts with labels of their own stand far behind the shelf.
    """
    rng = np.random.default_rng(0)
    true, said = (
        make_camera("side", width=640, height=480, focal=420.0, position=(0.0, 0.0, 0.8), yaw=np.pi / 2 + turn)
        for turn in (yaw, 0.0)
    )
    column, level = (grid.ravel() for grid in np.meshgrid(np.arange(COLUMNS), np.arange(3)))
    places = np.stack([1.0 + GAP * column, np.full(len(column), AWAY), 0.5 + 0.3 * level], axis=1)
    places += rng.uniform(-0.02, 0.02, places.shape)
    if noisy:
        places = np.concatenate([places, [(x, 5.0, 1.0) for x in (-0.5, 1.5, 3.0, 5.0)]])
        level = np.concatenate([level, [3, 4, 5, 6]])
    stamps = np.arange(0.0, 38.0, 0.1)
    there = stamps < 19.0
    way = np.where(there, 0.2 * stamps, 7.6 - 0.2 * stamps)
    away = -0.5 * np.clip((stamps - 17.0) / 4.0, 0.0, 1.0)
    plane = np.stack([way, away, np.zeros_like(stamps)], axis=1)
    path = lift_se2(plane)
    given = lift_se2(plane + rng.standard_normal(plane.shape) * (0.02, 0.02, 0.005)) if noisy else path
    taken = stamps[::6]
    frame, boxes, label = [], [], []
    for number, pose in enumerate(path[::6]):
        in_camera = np.linalg.inv(pose @ true.base_T_camera)
        at = places @ in_camera[:3, :3].T + in_camera[:3, 3]
        ahead = at[:, 2] > 0.1
        centre = (at[ahead] @ true.matrix.T)[:, :2] / at[ahead, 2:]
        half = true.matrix[0, 0] * np.array([0.035, 0.12]) / at[ahead, 2:]
        box = np.hstack([centre - half, centre + half]) + pixels * rng.standard_normal((len(centre), 4))
        inside = (box[:, :2] > 4).all(axis=1) & (box[:, 2] < 636) & (box[:, 3] < 476)
        frame += [number] * int(inside.sum())
        boxes.append(box[inside])
        label += level[ahead][inside].tolist()
    count = len(frame)
    found = Detections(
        taken, np.array(frame), np.vstack(boxes), np.array(label), np.full(count, 0.9),
        np.full(count, np.nan), np.full(count, -1), ("bottle", "box", "can", "post", "pole", "sign", "lamp"),
    )  # fmt: skip
    return Log("shelf", (CameraLog(said, found),), localization=Trajectory(stamps, given)), places


def counted(log: Log, places: np.ndarray, mode: str) -> tuple[int, int]:
    """The things with an object within a third of the gap, and the objects without a thing there."""
    settings = load_settings(None, ("output.recording=false", "bodies.use=false", f"mode={mode}"))
    points = np.array([one.position for one in pipeline.run(log, settings, Ledger()).map.resolved()]).reshape(-1, 3)
    near = np.linalg.norm(places[:, None] - points[None], axis=2) < GAP / 3 + 0.02
    return int(near.any(axis=1).sum()), int((~near.any(axis=0)).sum())


@pytest.mark.parametrize(
    ("mode", "odometry", "yaw"),
    [("fixed", False, 0.0), ("fixed", False, np.radians(1.0)), ("joint", False, 0.0), ("joint", True, np.radians(1.0))],
)
def test_a_shelf_of_equal_things_is_mapped_with_default_settings(mode, odometry, yaw):
    log, places = shelf(yaw)
    found, false = counted(replace(log, odometry=log.localization) if odometry else log, places, mode)
    assert found >= 0.95 * len(places)
    assert false <= 0.05 * len(places)


def test_a_shelf_at_noisy_poses_is_at_rest():
    """Tracks of its things pass on to their neighbours, and near things miss their rays by the noise of the poses."""
    found, false = counted(*shelf(noisy=True), "fixed")
    assert found >= 29
    assert false <= 2
