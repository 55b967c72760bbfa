"""Boxes that a detector gives to the robot's own arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.core.types import Log

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
