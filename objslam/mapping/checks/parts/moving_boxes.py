"""Find out whether the boxes of a period of time show that the camera moved, or that it stood."""

import numpy as np

from objslam.core.arrays import Bools
from objslam.core.types import Detections, Log

_NEAR = 12.0
"""The largest distance (px) between the centres of two boxes at one place of the image. It exceeds the noise of boxes.
Things that a moving camera passes move farther within `_LATER`. A larger distance takes slow motion for a stop."""
_NEAR_SHARE = 0.1
"""If this share of the mean of a box's width and height is larger than `_NEAR`, it replaces `_NEAR`. The noise of a box
grows with its size."""
_LATER = 2.0
"""The time (s) after which a box shows whether it moved. A longer time shows slower motions, and needs longer stops."""
_STAYS = 0.25
"""The least share of other frames with a box of the same label at the same place, for a box that stays. Frames at least
`_LATER` away with a box of the label count. Detectors miss a thing in some frames, and moving boxes come back to one place
in few frames. With a larger share, a thing that is often missed beside others of its label does not stay."""
_STEP = 0.25
"""The largest distance that a box moves from one frame to the next, as a share of the image's width. A robot that turns by a
radian a second moves a box by this share at 4 frames a second. A larger share takes more false boxes for things that
move."""
_FEWEST = 5
"""The fewest boxes of a label that show whether its things move."""
_ASKED = 400
"""The most boxes of a label that are compared with all others, spread evenly over the time. More boxes take longer."""


def boxes_move(log: Log, start: float, end: float) -> bool:
    """Return whether the boxes of most labels move through the image between two stamps, as if the camera moved.

    A label stands if more of its boxes stay than move. A label may have several things, each at its own place. A box moves
    if it does not stay, and if the previous or the next image has a box near it. So false boxes, which are somewhere else in
    each image, do not move. Two labels must move if the log has several, because people also move past a robot that waits.
    All cameras see the same people, so a label counts once, however many cameras see it move.
    """
    moving, still, labels = list[str](), 0, set[str]()
    for one in log.cameras:
        found = one.detections
        if found is None or one.mount is not None:  # An arm moves a camera while the base stands still.
            continue
        labels |= {found.label_names[label] for label in np.unique(found.label).tolist()}
        inside = (found.frame_stamps >= start + 1) & (found.frame_stamps <= end - 1)
        in_time = inside[found.frame]
        for label in np.unique(found.label[in_time]):
            mine = in_time & (found.label == label)
            if mine.sum() >= _FEWEST:
                stays, moves = _stays_and_moves(found.take(mine), one.camera.width * _STEP)
                moving += [found.label_names[int(label)]] * bool(moves.mean() > 0.5)
                still += bool(stays.sum() > moves.sum())
    return len(moving) > 2 * still and len(set(moving)) >= min(2, len(labels))


def _stays_and_moves(boxes: Detections, step: float) -> tuple[Bools, Bools]:
    """Return which boxes of one label (A,) stay, and which boxes (A,) move. At most `_ASKED` boxes are judged.

    step: px, the farthest way of a box from one frame to the next.
    """
    asked = np.unique(np.linspace(0, len(boxes) - 1, _ASKED).astype(np.int64))
    centre, size = (boxes.boxes[:, :2] + boxes.boxes[:, 2:]) / 2, boxes.boxes[:, 2:] - boxes.boxes[:, :2]
    away = np.linalg.norm(centre[asked, None] - centre[None], axis=2)
    near = away < np.maximum(_NEAR, _NEAR_SHARE * size[asked].mean(axis=1))[:, None]
    later = np.abs(boxes.stamps[asked, None] - boxes.stamps[None]) >= _LATER
    showing = np.unique(boxes.stamps)
    others = (np.abs(boxes.stamps[asked, None] - showing[None]) >= _LATER).sum(axis=1)
    stays = (near & later).sum(axis=1) > _STAYS * others
    beside = np.abs(boxes.frame[asked, None] - boxes.frame[None]) == 1
    return stays, ~stays & (beside & (away < step)).any(axis=1)
