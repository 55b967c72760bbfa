"""Things that are there in one lap only, such as cars that parked: a doubt names them, and no thing that stays."""

from dataclasses import replace

import numpy as np
import pytest
from mapping.hiding_drives import Solid, hiding_drive

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.mapping.moves import temporary_things

SETTINGS = load_settings(None, ("mode=fixed", "output.recording=false"))


def scene() -> list[Solid]:
    """Six round carts and three stools in a ring around the robot."""
    half = {"cart": np.array([0.4, 0.3, 0.45]), "stool": np.array([0.2, 0.2, 0.25])}
    turns = {"cart": np.linspace(0, 2 * np.pi, 6, endpoint=False), "stool": np.linspace(0.5, 4.7, 3)}
    kinds = [(label, far, turn) for label, far in (("cart", 3.4), ("stool", 2.9)) for turn in turns[label].tolist()]
    return [
        Solid(
            "cylinder",
            label,
            np.array([far * 1.2 * np.cos(turn), far * np.sin(turn), half[label][2]]),
            half[label],
            0.1 + 0.13 * number,
        )
        for number, (label, far, turn) in enumerate(kinds)
    ]


def without(log: Log, place: np.ndarray, *, late: bool) -> Log:
    """The log without the boxes of the cart at a place (2,) in one of its two laps."""
    (one,) = log.cameras
    found = one.detections
    pose = log.truth.trajectory.poses[found.frame] @ one.camera.base_T_camera
    local = np.einsum("nij,ni->nj", pose[:, :3, :3], np.append(place, 0.45) - pose[:, :3, 3])
    pixel = local[:, :2] / np.maximum(local[:, 2:], 0.1) * np.diag(one.camera.matrix)[:2] + one.camera.matrix[:2, 2]
    boxes = found.boxes
    inside = ((pixel > boxes[:, :2]) & (pixel < boxes[:, 2:])).all(axis=1) & (local[:, 2] > 0)
    of_lap = (found.frame > found.frame.max() / 2) == late
    gone = inside & of_lap & (found.label == found.label_names.index("cart"))
    return replace(log, cameras=(replace(one, detections=found.take(~gone)),))


@pytest.mark.parametrize("late", [True, False])
def test_a_cart_that_is_there_in_one_lap_only_is_named(late):
    solids = scene()
    log = without(hiding_drive(0, solids=solids, frames=700), solids[2].centre[:2], late=late)
    result = pipeline.run(log, SETTINGS, Ledger())
    named = [one for one in result.doubts if one.kind == "moved"]
    assert [(one.label, one.reason) for one in named] == [("cart", "left" if late else "came")]
    assert np.linalg.norm(named[0].position[:2] - solids[2].centre[:2]) < 0.3
    assert named[0].numbers["frames_after" if late else "frames_before"] >= 15
    assert result.summary["doubts"]["moved"] == 1
    assert any("there for a part of the drive only: cart #" in one for one in result.summary["assessment"]["reasons"])


def test_things_that_stay_are_not_named():
    result = pipeline.run(hiding_drive(0, solids=scene(), frames=700), SETTINGS, Ledger())
    assert len(result.map.resolved()) >= 8
    assert not [one for one in result.doubts if one.kind == "moved"]
    assert temporary_things.in_assessment([]) == []
