"""Whether boxes move as those of a camera that moves, in images drawn from a known scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from objslam.core.camera import Camera
from objslam.core.types import CameraLog, Detections, Log
from objslam.mapping.checks.parts.moving_boxes import boxes_move

SIZE = np.array([640, 480])
THINGS = (("chair", 120.0, 250.0), ("chair", 400.0, 260.0), ("cup", 200.0, 330.0), ("cup", 520.0, 300.0))
"""The label of each thing and its place in the image at the begin, px."""
NAMES = ("bin", "chair", "cup", "person")


def log_of(
    seed: int, *, speed: float = 0.0, missed: float = 0.3, false: float = 0.0, walking: bool = False, things: int = 4
) -> Log:
    """24 s of boxes at 5 Hz, from -4 s on, when all things are in view. speed: px/s, of things as the camera turns to and
    fro. false: boxes an image. things: how many are in view from 0 s on."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(-4.0, 20.0, 0.2)
    rows = []
    for frame, stamp in enumerate(stamps):
        way = speed * abs((stamp + 5) % 20 - 10)
        for name, x, y in THINGS[: things if stamp >= 0 else None]:
            at = (x - way) % SIZE[0], y
            rows += [(frame, name, *at)] if rng.random() >= missed else []
        rows += [(frame, "person", 60 * stamp % SIZE[0], 240.0)] if walking else []
        rows += [(frame, str(rng.choice(NAMES)), *rng.uniform(40, SIZE - 40)) for _ in range(rng.poisson(false))]
    centre = np.array([row[2:] for row in rows]) + rng.normal(0, 2, (len(rows), 2))
    detections = Detections(
        frame_stamps=stamps,
        frame=np.array([row[0] for row in rows]),
        boxes=np.concatenate([centre - 30, centre + 30], axis=1),
        label=np.array([NAMES.index(row[1]) for row in rows]),
        scores=np.ones(len(rows)),
        depths=np.full(len(rows), np.nan),
        track_ids=np.full(len(rows), -1),
        label_names=NAMES,
    )
    return Log("log", (CameraLog(Camera("front", 640, 480, np.diag([500.0, 500, 1])), detections),))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "more",
    [
        {},
        {"missed": 0.6},
        {"false": 0.5},
        {"walking": True},
        {"things": 0, "walking": True},
        {"things": 0, "walking": True, "false": 0.5},
        {"things": 0, "false": 0.5},
    ],
)
def test_a_camera_that_stands_sees_things_that_stand_beside_people_and_false_boxes(seed, more):
    assert not boxes_move(log_of(seed, **more), 0.0, 20.0)


@pytest.mark.parametrize("seed", range(3))
def test_people_who_walk_past_two_cameras_are_one_label_that_moves(seed):
    """Things at rest were in view before the robot stood."""
    front, back = (log_of(number, things=0, walking=True).cameras[0] for number in (seed, seed + 10))
    back = replace(back, camera=replace(back.camera, name="back"))
    assert not boxes_move(Log("log", (front, back)), 0.0, 20.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("more", [{}, {"missed": 0.6}, {"false": 0.5}, {"walking": True}, {"speed": 300.0}])
def test_a_camera_that_turns_moves_its_boxes(seed, more):
    assert boxes_move(log_of(seed, **({"speed": 40.0} | more)), 0.0, 20.0)
