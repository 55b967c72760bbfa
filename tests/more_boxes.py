"""Put more boxes into a log."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.types import Log


def with_boxes(log: Log, frames: Ints, boxes: Floats, label: str) -> Log:
    """The log with more boxes (n, 4) of a label in frames (n,) of its first camera."""
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


def left_parts(boxes: Floats) -> Floats:
    """The left parts of boxes (n, 4)."""
    return np.column_stack([boxes[:, :2], 0.55 * boxes[:, 2] + 0.45 * boxes[:, 0], boxes[:, 3]])


def aside(boxes: Floats) -> Floats:
    """Boxes as large as others (n, 4), a quarter of a box away along both axes, each in one of four directions."""
    way = np.random.default_rng(0).choice([-0.25, 0.25], (len(boxes), 2))
    return boxes + np.tile(way * (boxes[:, 2:] - boxes[:, :2]), 2)


def with_second_boxes(log: Log, some: Ints, second: Callable[[Floats], Floats]) -> Log:
    """The log with a second box for some boxes (n,) of its first camera, with half of the score. second: makes these boxes
    (n, 4) of the first ones."""
    found = log.cameras[0].detections
    assert found is not None
    rows = np.sort(np.concatenate([np.arange(len(found)), some]))
    again = np.flatnonzero(np.diff(rows) == 0) + 1
    more = found.take(rows)
    boxes, scores = more.boxes.copy(), more.scores.copy()
    boxes[again] = second(boxes[again])
    scores[again] *= 0.5
    return replace(log, cameras=(replace(log.cameras[0], detections=replace(more, boxes=boxes, scores=scores)),))


def nearly_equal(boxes: Floats) -> Floats:
    """Boxes whose edges differ from those of others (n, 4) by 2 % of their size."""
    size = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1))
    return boxes + 0.02 * size[:, None] * np.random.default_rng(0).normal(size=boxes.shape)


def with_second_labels(log: Log, some: Ints) -> Log:
    """The log with a second box for some boxes (n,) of its first camera, nearly equal, with another label and half of the
    score."""
    changed = with_second_boxes(log, some, nearly_equal)
    found = changed.cameras[0].detections
    assert found is not None
    names, label = found.label_names, found.label.copy()
    again = some + np.arange(1, len(some) + 1)
    label[again] += len(names)
    more = replace(found, label=label, label_names=(*names, *(f"like {name}" for name in names)))
    return replace(changed, cameras=(replace(changed.cameras[0], detections=more),))
