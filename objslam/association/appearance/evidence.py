"""What appearance vectors say about rays and landmarks: learn the ratio from an association, and apply it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.association.appearance.cosine_ratio import CosineRatio, Pairs
from objslam.association.observations import Observations, overlap
from objslam.core.arrays import Bools, Floats, Floats32, Ints
from objslam.core.types import Rays

Boxes = Observations | Rays
"""Boxes with labels, corners and appearance vectors."""
_BESIDE = 8
"""Each box is compared with this number of boxes of its label that follow it in its frame. A larger number gives more pairs
of different objects where a frame has many boxes, and takes longer."""
_DUPLICATE = 0.5
"""The intersection over union above which two boxes of one frame may show one object. A larger value learns from more
pairs."""
_AT_ONCE = 1 << 24  # The most elements of vectors that are multiplied at once. A larger value needs more memory.


@dataclass(frozen=True)
class Looks:
    """What landmarks look like. ratio: the densities of cosines, learnt from the log. total: (N, D) the sum of the vectors
    of each landmark's boxes. number: (N,) how many vectors each landmark has."""

    ratio: CosineRatio
    total: Floats32
    number: Ints

    @classmethod
    def of(cls, boxes: Boxes, owner: Ints, count: int, ratio: CosineRatio) -> Self:
        """Return the looks of landmarks. owner: (R,) the landmark of each box, -1 for none. count: the number N of
        landmarks."""
        from scipy.sparse import csr_array

        feature, vectors = _vectors(boxes)
        some = np.flatnonzero((owner >= 0) & (feature >= 0))
        which = csr_array((np.ones(len(some), np.float32), (owner[some], feature[some])), shape=(count, len(vectors)))
        return cls(ratio, np.asarray(which @ vectors), np.bincount(owner[some], minlength=count))

    def ray_odds(self, boxes: Boxes, ray: Ints, landmark: Ints, own: Bools) -> Floats:
        """Return the log odds (E,) that boxes show landmarks, and not other objects of their labels.

        ray, landmark: (E,) the indices of the boxes and of the landmarks. own: (E,) whether the box belongs to the landmark.
        Such a box is not compared with itself. The odds are 0 if the box, or all other boxes of the landmark, have no
        vector.
        """
        feature, vectors = _vectors(boxes)
        others = self.number[landmark] - own
        odds, known = np.zeros(len(ray)), np.flatnonzero((feature[ray] >= 0) & (others > 0))
        ray, landmark, others = ray[known], landmark[known], others[known]
        cosine = (_products(vectors, feature[ray], self.total, landmark) - own[known]) / others
        odds[known] = self.ratio.log_ratio(cosine, boxes.label[ray], 1, others)
        return odds

    def landmark_odds(self, a: Ints, b: Ints, label: Ints) -> Floats:
        """Return the log odds (P,) that landmarks `a` and `b` (P,) are one object of a label (P,), and not two. The odds are
        0 if one of the two landmarks has no vector."""
        odds, known = np.zeros(len(a)), np.flatnonzero((self.number[a] > 0) & (self.number[b] > 0))
        a, b = a[known], b[known]
        cosine = _products(self.total, a, self.total, b) / (self.number[a] * self.number[b])
        odds[known] = self.ratio.log_ratio(cosine, label[known], self.number[a], self.number[b])
        return odds


def learn_ratio(boxes: Boxes, frame: Ints, track: Ints, owner: Ints, labels: int) -> CosineRatio | None:
    """Return the ratio, learnt from boxes and their landmarks. Return None if the boxes have no vectors that tell objects
    apart.

    Consecutive boxes of one landmark, or of one track, show one object. Boxes of one label in one frame that hardly overlap
    show two objects. frame, track, owner: (R,) the frame, the track and the landmark of each box, -1 for no track and for no
    landmark. labels: the number of all labels.
    """
    if boxes.feature is None:
        return None
    same = [_followers(boxes, frame, group) for group in (owner, track)]
    first, second = np.unique(np.concatenate([np.stack(pair) for pair in same], axis=1), axis=1)
    landmarks = int(owner.max(initial=-1)) + 1
    _, thing = np.unique(np.where((owner < 0) & (track >= 0), landmarks + track, owner), return_inverse=True)
    a, b = _beside(boxes, frame)
    two, count = np.sort(np.stack([thing[a], thing[b]]), axis=0), int(thing.max(initial=0)) + 1
    known = ((owner >= 0) | (track >= 0))[np.stack([a, b])].all(axis=0)
    alone = count**2 + np.arange(len(a))  # A box without a landmark and a track is an object of its own.
    ratio = CosineRatio.learn(
        Pairs(_cosines(boxes, first, second), boxes.label[first], thing[first]),
        Pairs(_cosines(boxes, a, b), boxes.label[a], np.where(known, two[0] * count + two[1], alone)),
        labels,
    )
    return ratio if ratio.informative else None


def _followers(boxes: Boxes, frame: Ints, group: Ints) -> tuple[Ints, Ints]:
    """Return the pairs (P,) of consecutive boxes of a group that have the same label. Only boxes with a vector count."""
    feature, _ = _vectors(boxes)
    some = np.flatnonzero((group >= 0) & (feature >= 0))
    some = some[np.lexsort((frame[some], group[some]))]
    near = (np.diff(group[some]) == 0) & (np.diff(frame[some]) > 0) & (np.diff(boxes.label[some]) == 0)
    return some[:-1][near], some[1:][near]


def _beside(boxes: Boxes, frame: Ints) -> tuple[Ints, Ints]:
    """Return the pairs (P,) of boxes of one label in one frame that hardly overlap. Only boxes with a vector count."""
    feature, _ = _vectors(boxes)
    some = np.flatnonzero(feature >= 0)
    some = some[np.lexsort((boxes.label[some], frame[some]))]
    first, second = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for step in range(1, _BESIDE + 1):
        a, b = some[:-step], some[step:]
        together = (frame[a] == frame[b]) & (boxes.label[a] == boxes.label[b])
        together &= overlap(boxes.box[a], boxes.box[b]) < _DUPLICATE
        first.append(a[together])
        second.append(b[together])
    return np.concatenate(first), np.concatenate(second)


def _vectors(boxes: Boxes) -> tuple[Ints, Floats32]:
    """Return the row (R,) of each box in a table of vectors, -1 without a vector, and the table (V, D)."""
    assert boxes.feature is not None
    assert boxes.feature_table is not None
    return boxes.feature, boxes.feature_table.compact


def _cosines(boxes: Boxes, first: Ints, second: Ints) -> Floats:
    feature, vectors = _vectors(boxes)
    return _products(vectors, feature[first], vectors, feature[second])


def _products(left: Floats32, one: Ints, right: Floats32, other: Ints) -> Floats:
    """Return the inner products (P,) of rows `one` (P,) of `left` (V, D) and rows `other` (P,) of `right` (W, D)."""
    result = np.empty(len(one))
    step = max(1, _AT_ONCE // left.shape[1])
    for at in range(0, len(one), step):
        part = slice(at, at + step)
        result[part] = np.einsum("pd,pd->p", left[one[part]], right[other[part]])
    return result
