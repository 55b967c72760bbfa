"""Find boxes of parts of the robot while a session runs, with bounded memory. The rules are those of `robot_parts`."""

from dataclasses import dataclass, field

import numpy as np

from objslam.association.observations import overlap
from objslam.core.arrays import Bools, Floats, Ints
from objslam.frontend.boxes.robot_parts import (
    ABSENT,
    AGREE,
    FEWEST,
    LIKE_BOX,
    NEXT,
    SAME_BOX,
    STEADY,
    TURN,
    WINDOWS,
    drifts,
    misses,
)

_PLACES = 16
"""The most places of the image that are followed for each label. A place is still followed if it has more than one in 17
boxes of the label (Misra and Gries 1982). A larger number finds rarer boxes and takes longer."""
_OF_WINDOW = 32
"""The most rays of a window that are kept. They are spread evenly. A larger number takes more memory."""
_MOVED = np.cos(np.radians(1.0))
"""The cosine of the angle by which the camera must turn after a kept ray before the next ray is kept. So a robot that waits
adds no rays. A larger cosine keeps more rays."""
_GAPS = 31
"""The number of last gaps between two boxes from which the usual gap is taken. A larger number takes more memory."""
_FORGOTTEN = 500
"""The number of frames after which a part of the robot is forgotten if none of them shows it. An arm may have moved away.
With a larger number, boxes of things at the old place of the part are dropped for longer."""


@dataclass
class _Place:
    """A place of the image where boxes of one label are. box: (4,) px, the mean of its first boxes. hits: the number of
    boxes here, less the number of boxes of the label that found all places taken. at, near: the numbers of boxes at the
    place, and near it. last: the last frame with a box here. ahead, origin, direction: the camera's axis, the origin and the
    direction of each ray in the present window. open: the earlier windows, at most `NEXT`, whose rays still meet. Each has
    its number, and the origins and directions of the rays since its start. missed: how many checks of windows showed no
    thing at rest. windows: the number of windows. latest: (4,) px, the last box. changes: the number of changes of the box
    from one image to the next, and the sums of the changes and of their squares. gaps: the last numbers of frames between
    two boxes.
    """

    box: Floats
    last: int
    hits: int = 1
    at: int = 1
    near: int = 1
    missed: int = 0
    windows: int = 0
    ahead: list[Floats] = field(default_factory=list)
    origin: list[Floats] = field(default_factory=list)
    direction: list[Floats] = field(default_factory=list)
    open: list[tuple[int, list[Floats], list[Floats]]] = field(default_factory=list)
    latest: Floats = field(default_factory=lambda: np.zeros(4))
    gaps: list[int] = field(default_factory=list)
    changes: tuple[int, Floats, Floats] = field(default_factory=lambda: (0, np.zeros(4), np.zeros(4)))

    @property
    def is_part(self) -> bool:
        """Whether the boxes of this place show a part of the robot."""
        enough = self.at >= FEWEST and self.at >= STEADY * self.near
        return enough and self.missed >= max(WINDOWS, AGREE * self.windows) and not drifts(*self.changes)

    def add(self, box: Floats, frame: int, pose: Floats, direction: Floats) -> None:
        """Add a box at this place. pose: (4, 4) of the camera. direction: (3,) of the ray, in the frame of the path."""
        if self.at < FEWEST:  # A mean of later boxes would follow a thing that moves slowly through the image.
            self.box += (box - self.box) / (self.at + 1)
        if frame == self.last + 1 and self.latest.any():
            count, total, squares = self.changes
            change = box - self.latest
            self.changes = count + 1, total + change, squares + change**2
        self.latest = box
        if self.gaps and frame - self.last > ABSENT * float(np.median(self.gaps)):
            self.open = []
            self._keep(slice(0, 0))
        self.gaps = [*self.gaps[1 - _GAPS :], frame - self.last]
        self.hits, self.at, self.near, self.last = self.hits + 1, self.at + 1, self.near + 1, frame
        ahead = pose[:3, 2]
        if self.ahead and ahead @ self.ahead[-1] > _MOVED:
            return
        for values, value in ((self.ahead, ahead), (self.origin, pose[:3, 3]), (self.direction, direction)):
            values.append(value)
        if ahead @ self.ahead[0] < np.cos(TURN):
            self._end_window()
            self._keep(slice(-1, None))
        elif len(self.ahead) > _OF_WINDOW:
            self._keep(slice(None, None, 2))

    def _end_window(self) -> None:
        """End the present window. Add to `missed` the windows, this one and open ones, whose rays do not meet."""
        self.windows += 1
        begun = [*self.open, (self.windows, [], [])]
        longer = [(first, origin + self.origin, direction + self.direction) for first, origin, direction in begun]
        meet = [one for one in longer if not misses(np.array(one[1]), np.array(one[2]))]
        self.missed += len(longer) - len(meet)
        self.open = [one for one in meet if self.windows - one[0] < NEXT]

    def _keep(self, some: slice) -> None:
        self.ahead, self.origin, self.direction = self.ahead[some], self.origin[some], self.direction[some]


class RobotPartFinder:
    """Finds, frame by frame, which boxes of one camera show parts of the robot."""

    def __init__(self) -> None:
        self._places: dict[int, list[_Place]] = {}
        self._frame = 0

    def add(self, boxes: Floats, label: Ints, pose: Floats, direction: Floats) -> Bools:
        """Add the boxes of a frame. Return which of them show parts of the robot, (n,).

        boxes: (n, 4) px. label: (n,). pose: (4, 4) of the camera, in the frame of the odometry or the localisation.
        direction: (n, 3) of the rays of the boxes, in the frame of the camera.
        """
        self._frame += 1
        turned = direction @ pose[:3, :3].T
        part = np.zeros(len(boxes), dtype=bool)
        for index, (box, number, ray) in enumerate(zip(boxes, label.tolist(), turned, strict=True)):
            part[index] = self._add(box, number, pose, ray)
        return part

    def are_parts(self, boxes: Floats, label: Ints) -> Bools:
        """Return which boxes (n, 4) px with labels (n,) are where a part of the robot is now."""
        part = np.zeros(len(boxes), dtype=bool)
        for number, places in self._places.items():
            mine = np.flatnonzero(label == number)
            for place in places:
                if len(mine) and place.is_part:
                    part[mine] |= overlap(place.box, boxes[mine]) >= SAME_BOX
        return part

    def _add(self, box: Floats, label: int, pose: Floats, direction: Floats) -> bool:
        places = self._places.setdefault(label, [])
        places[:] = [one for one in places if not one.is_part or self._frame - one.last <= _FORGOTTEN]
        if places:
            alike = overlap(np.array([one.box for one in places]), box)
            best = int(alike.argmax())
            for index in np.flatnonzero(alike >= LIKE_BOX).tolist():
                if index != best or alike[best] < SAME_BOX:
                    places[index].near += 1
            if alike[best] >= SAME_BOX:
                places[best].add(box, self._frame, pose, direction)
                return places[best].is_part
        if len(places) < _PLACES:
            places.append(_Place(box.copy(), self._frame))
            return False
        for one in places:
            one.hits -= 1
        places[:] = [one for one in places if one.hits > 0 or one.is_part]
        return False
