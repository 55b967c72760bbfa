"""Find boxes that give the thing of another box a second label.

A detector whose suppression works label by label may give a thing two boxes with different labels in one image, for example
"potted plant" and "vase". The boxes are nearly equal. From some viewpoints, two things may also have nearly equal boxes. So
two labels count as labels of one thing only if most of their boxes that lie on each other are nearly equal.
"""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from objslam.association.duplicates import show_one_thing
from objslam.association.observations import overlap
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Log

SECOND_LABELS = "boxes on a surer box with another label (second labels of things; rays.second_labels)"
"""The reason to drop boxes with second labels."""
_NEARLY_EQUAL = 0.8
"""The least intersection over union of two nearly equal boxes. Two boxes of equal size, one of them shifted sideways by a
ninth of its width, have this value. Second boxes whose edges err by 2 % of their size have 0.85 and more. With a larger
value, second labels with noisier edges become objects."""
_MOST = 0.5
"""The least share of nearly equal boxes, among the boxes of two labels that lie on each other, if both are labels of one
thing. Equally large boxes that pass each other sideways have a share of 0.22. They lie on each other if they are less than
half a width apart, and are nearly equal if less than a ninth of a width apart. In simulated rooms with second labels, pairs
of such labels have a share of 0.85 to 1, and pairs of labels of two things at most 0.03. A larger share drops fewer
boxes."""
_OTHERS = 5.0
"""The weight, as a number of boxes, of the share of all other pairs of labels in the decision about one pair. That share
shows what the detector does. Without other pairs, two labels need at least this number of nearly equal boxes to be labels of
one thing. With a larger number, rare pairs follow the others more."""
_STEPS = 8.0
"""The number of places of the image in the size of a box, along each axis. Boxes at one place count once, so that a robot
that waits shows nothing new. A larger number tells more places apart, and the boxes of a robot that waits count more
often."""
_COMPARED = 64  # The most boxes of a frame that each box is compared with. A larger number takes longer.
_MOST_PLACES = 20_000
"""The most places that a session remembers, of all pairs of labels. Later places do not count. A larger number takes more
memory."""


@dataclass(frozen=True)
class Pairs:
    """Pairs of boxes of one frame that lie on each other, and have different labels.

    first, second: (P,) the indices of the surer box and of the other one. labels: (P, 2) their labels, the smaller number
    first. equal: (P,) whether the boxes are nearly equal. place: (P, 5) where in the image the first box is.
    """

    first: Ints
    second: Ints
    labels: Ints
    equal: Bools
    place: Ints


def without_second_labels(log: Log, settings: Settings, ledger: Ledger) -> Log:
    """Return the log without the boxes that give the thing of another box a second label. The ledger counts them.

    `Detections.second` of the boxes that stay keeps the second labels. Fiducials stay, and so do the boxes of cameras whose
    boxes show no size.
    """
    if not settings.rays.second_labels:
        return log
    names = sorted({name for one in log.cameras if one.detections is not None for name in one.detections.label_names})
    number = {name: i for i, name in enumerate(names)}
    found = {i: _pairs_of(one, number, settings) for i, one in enumerate(log.cameras) if _can_tell(one)}
    pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(one.labels for one in found.values())])
    equal = np.concatenate([np.zeros(0, dtype=bool), *(one.equal for one in found.values())])
    if not equal.any():
        return log
    camera = np.repeat(list(found), [len(one.first) for one in found.values()])
    place = np.concatenate([one.place for one in found.values()])
    kinds, code = np.unique(pairs, axis=0, return_inverse=True)
    seen = np.unique(np.column_stack([code.ravel(), equal, camera, place]), axis=0)
    near, same = (np.bincount(some[:, 0], minlength=len(kinds)).astype(float) for some in (seen, seen[seen[:, 1] > 0]))
    one_thing = labels_of_one_thing(same, near, same.sum(), near.sum())[code.ravel()] & equal
    cameras, dropped, at = list(log.cameras), Counter[tuple[str, str]](), 0
    for i, some in found.items():
        mine = one_thing[at : at + len(some.first)]
        at += len(mine)
        detections = log.cameras[i].detections
        if detections is not None and mine.any():
            less, counts = _without(detections, some.first[mine], some.second[mine])
            cameras[i] = replace(cameras[i], detections=less)
            dropped += counts
    if not dropped:
        return log
    for (label, other), count in dropped.most_common():
        ledger.drop(SECOND_LABELS, count, f"{label} on {other}, {count} boxes")
    ledger.drop(SECOND_LABELS, 0, of=sum(len(c.detections) for c in log.cameras if c.detections is not None))
    return replace(log, cameras=tuple(cameras))


def pairs_on_each_other(boxes: Floats, frame: Ints, label: Ints, scores: Floats) -> Pairs:
    """Return the pairs of boxes (M, 4) px of one frame that lie on each other and have different labels.

    The box with the higher score is the surer one. If the scores are equal, the box with the smaller label is the surer one.
    frame, label, scores: (M,) of the boxes.
    """
    rank = np.empty(len(boxes), dtype=np.int64)
    rank[np.lexsort((label, -scores))] = np.arange(len(boxes))
    order = np.lexsort((boxes[:, 0], frame))
    last = np.searchsorted(frame[order], frame[order], side="right") - 1
    start, found = np.arange(len(boxes)), [np.zeros((0, 2), dtype=np.int64)]
    for step in range(1, _COMPARED + 1):
        start = start[start + step <= last[start]]
        if not len(start):
            break
        two = np.column_stack([order[start], order[start + step]])
        two = two[label[two[:, 0]] != label[two[:, 1]]]
        found.append(two[show_one_thing(boxes[two[:, 0]], boxes[two[:, 1]])])
    both = np.concatenate(found)
    both = np.where((rank[both[:, 0]] < rank[both[:, 1]])[:, None], both, both[:, ::-1])
    first, second = both[np.lexsort((rank[both[:, 1]], rank[both[:, 0]]))].T
    equal = overlap(boxes[first], boxes[second]) >= _NEARLY_EQUAL
    labels = np.sort(np.column_stack([label[first], label[second]]), axis=1)
    return Pairs(first, second, labels, equal, _places(boxes[first]))


def labels_of_one_thing(same: Floats, near: Floats, every_same: float, every_near: float) -> Bools:
    """Return which pairs of labels (P,) are labels of one thing.

    near: (P,) the number of places at which boxes of the two labels lie on each other. same: (P,) the number of places at
    which such boxes are nearly equal. every_same, every_near: the sums of both over all pairs of labels.
    """
    others = (every_same - same) / (every_near - near + _OTHERS)
    return np.asarray(same + _OTHERS * others >= _MOST * (near + _OTHERS))


@dataclass
class SecondLabelFinder:
    """Finds, frame by frame, which boxes of a session give things second labels. The finder decides by the frames that it
    has seen so far."""

    _seen: set[tuple[int, ...]] = field(default_factory=set)
    _near: Counter[tuple[int, int]] = field(default_factory=Counter)
    _same: Counter[tuple[int, int]] = field(default_factory=Counter)

    def add(self, camera: int, boxes: Floats, label: Ints, scores: Floats) -> tuple[Ints, Ints]:
        """Add a frame, and return the indices of its boxes with second labels (n,), and of the boxes below them (n,).

        camera: the number of the camera. boxes: (M, 4) px. label, scores: (M,) of the boxes.
        """
        few = len(boxes) <= _COMPARED  # All pairs of 9,900 boxes took 7 s and gigabytes.
        if few and not _lie_on_each_other(boxes, label):  # True for most frames, and ten times as fast.
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        pairs = pairs_on_each_other(boxes, np.zeros(len(boxes), dtype=np.int64), label, scores)
        for (a, b), equal, place in zip(pairs.labels.tolist(), pairs.equal.tolist(), pairs.place.tolist(), strict=True):
            key = (a, b, int(equal), camera, *place)
            if key not in self._seen and len(self._seen) < _MOST_PLACES:
                self._seen.add(key)
                self._near[a, b] += 1
                self._same[a, b] += equal
        return self._second(pairs)

    def second_boxes(self, boxes: Floats, frame: Ints, label: Ints, scores: Floats) -> tuple[Ints, Ints]:
        """Return the same indices as `add`, but for the boxes (M, 4) px of several frames. The frames that were added before
        decide. This method adds no frame. frame, label, scores: (M,) of the boxes."""
        return self._second(pairs_on_each_other(boxes, frame, label, scores))

    def _second(self, pairs: Pairs) -> tuple[Ints, Ints]:
        keys, which = np.unique(pairs.labels, axis=0, return_inverse=True)
        same, near = (np.array([of[a, b] for a, b in keys.tolist()], dtype=float) for of in (self._same, self._near))
        one = labels_of_one_thing(same, near, self._same.total(), self._near.total())[which.ravel()] & pairs.equal
        return _without_repeats(pairs.first[one], pairs.second[one])


def _lie_on_each_other(boxes: Floats, label: Ints) -> bool:
    """Return whether two boxes (M, 4) of a frame, px, lie on each other and have different labels (M,)."""
    return bool((show_one_thing(boxes[:, None], boxes) & (label[:, None] != label)).any())


def _places(boxes: Floats) -> Ints:
    """Return a row of integers (M, 5) for boxes (M, 4) px. Boxes at one place of the image have equal rows."""
    size = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0.0), 1.0)
    exponent = np.round(np.log2(size))
    at = np.round(_STEPS * boxes / np.exp2(exponent)[:, None])
    return np.column_stack([exponent, at]).astype(np.int64)


def _can_tell(one: CameraLog) -> bool:
    return one.detections is not None and tells_labels(one.camera, one.detections.whole)


def tells_labels(camera: Camera, whole: bool) -> bool:
    """Return whether boxes of a camera can show second labels. Bearings and fiducials cannot. whole: as in `Detections`."""
    return camera.sees_size and not whole


def _pairs_of(one: CameraLog, number: dict[str, int], settings: Settings) -> Pairs:
    """Return the pairs among the usable boxes of a camera. number: the number of each label."""
    found = one.detections
    assert found is not None
    usable = found.scores >= settings.rays.min_score
    if found.corners is not None:
        usable = usable & ~np.isfinite(found.corners[:, 0, 0])
    some = np.flatnonzero(usable)
    numbers = np.array([number[name] for name in found.label_names], dtype=np.int64)
    pairs = pairs_on_each_other(found.boxes[some], found.frame[some], numbers[found.label[some]], found.scores[some])
    return replace(pairs, first=some[pairs.first], second=some[pairs.second])


def _without_repeats(first: Ints, second: Ints) -> tuple[Ints, Ints]:
    """Return each second box once (n,), and the surest box that it lies on (n,). The pairs come surest first."""
    boxes, at = np.unique(second, return_index=True)
    return boxes, first[at]


def _without(found: Detections, first: Ints, second: Ints) -> tuple[Detections, Counter[tuple[str, str]]]:
    """Return the detections without the second boxes of pairs, and how many were left out, by their label and the label of
    the box below."""
    gone, below = _without_repeats(first, second)
    seconds = np.full(len(found), -1) if found.second is None else found.second.copy()
    seconds[below[::-1]] = found.label[gone[::-1]]  # A box keeps one second label.
    names = found.label_names
    kinds, counts = np.unique(np.column_stack([found.label[gone], found.label[below]]), axis=0, return_counts=True)
    named = Counter({(names[a], names[b]): int(n) for (a, b), n in zip(kinds.tolist(), counts, strict=True)})
    left = np.delete(np.arange(len(found)), gone)
    return replace(found, second=seconds).take(left), named
