"""Find pairs of objects that may be one: they lie close together, and no frame shows both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.association.duplicates import TOGETHER
from objslam.association.merging import common_frames
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import nearest_points
from objslam.core.statistics import SAME_POINT, logistic
from objslam.mapping.doubts.evidence import Evidence

_NEIGHBOURS = 8
"""The number of nearest objects that each object is compared with. A larger number is slower, and matters in dense places
only."""
_PRIOR = 0.05
"""The prior probability that two neighbours are one object. It is chosen, not measured: association has merged nearly all
copies. A larger value reports more pairs."""
_LEAST = 0.1
"""The least probability that a reported pair is one object. A larger value reports fewer pairs."""
_BOTH = 0.5
"""The share of the frames that really show both of two independent objects, among the frames that should show both. In the
other frames, one thing hides another, or a detector suppresses boxes that overlap. The share is chosen, not measured. With a
larger share, a frame without both is stronger evidence for one object."""
_BESIDES = 0.2
"""The number of frames that show both objects by chance, whether they are one or two. This number keeps the odds from few
frames finite. With a larger number, a few frames count less."""
_PAD = 1.0
"""The margin (m) around the objects in which other objects of their label may lie. With a larger margin, fewer pairs are
expected to be close by chance."""
_SHARED = 0.35
"""The largest distance between two objects that fill one space, as a share of the smaller size. The association has the same
limit. A larger share reports more pairs."""


@dataclass(frozen=True)
class Pairs:
    """P pairs of objects that may be one, the likeliest first.

    first, second: (P,) indices into the map. distance: (P,) m. sigmas: (P,) the distance in standard deviations, by the sum
    of both covariances. probability: (P,) the probability that the two are one object. together: (P,) the number of frames
    with boxes of both. expected: (P,) the number of frames that would show both if they were two objects.
    """

    first: Ints
    second: Ints
    distance: Floats
    sigmas: Floats
    probability: Floats
    together: Ints
    expected: Floats

    def __len__(self) -> int:
        return len(self.first)

    def take(self, which: Ints | Bools) -> Self:
        """Select pairs by a mask or by indices."""
        return type(self)(**{name: values[which] for name, values in vars(self).items()})


def find_pairs(evidence: Evidence) -> Pairs:
    """Return the pairs of objects that may be one.

    Two explanations are compared. If they are one object, the covariance of their offset is the sum of their covariances,
    and hardly any frame shows both (`TOGETHER`). If they are two objects, the second lies anywhere among the objects of its
    label, and each frame with both in view shows both. Objects that fill one space are candidates too, because two things
    cannot fill one space.
    """
    state, covariance = evidence.state, evidence.covariance
    position = state.landmarks.position
    if state.count < 2:
        return _none()
    found = nearest_points(position, min(_NEIGHBOURS + 1, state.count))
    pairs = np.stack([np.repeat(np.arange(state.count), found.shape[1]), found.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    a, b = pairs[:, 0], pairs[:, 1]
    meets = evidence.accepts[a, state.label[b]] | evidence.accepts[b, state.label[a]]
    offset = position[a] - position[b]
    gap = np.linalg.norm(offset, axis=1)
    both = covariance[a] + covariance[b] + 1e-12 * np.eye(3)
    squared = np.einsum("pi,pi->p", offset, np.linalg.solve(both, offset[..., None])[..., 0])
    shared = gap < _SHARED * np.minimum(state.size[a], state.size[b])
    kept = meets & ((squared < SAME_POINT) | shared)
    a, b, gap, both, squared, shared = (values[kept] for values in (a, b, gap, both, squared, shared))
    frames, in_view = common_frames(state.history, a, b)[:2]
    expected = _expected(state.history.seen, state.history.expected, in_view, a, b)
    if_one, if_two = TOGETHER * expected + _BESIDES, _BOTH * expected + _BESIDES
    by_frames = frames * np.log(if_one / if_two) + if_two - if_one
    as_one = -0.5 * (np.where(shared, np.minimum(squared, 3.0), squared) + np.linalg.slogdet(2 * np.pi * both)[1])
    as_two = np.log(_density(position, state.label, state.label[a], len(state.unassigned)))
    probability = logistic(as_one - as_two + by_frames + np.log(_PRIOR / (1 - _PRIOR)))
    result = Pairs(evidence.object[a], evidence.object[b], gap, np.sqrt(squared), probability, frames, expected)
    order = np.argsort(-probability, kind="stable")
    return result.take(order[probability[order] >= _LEAST])


def _none() -> Pairs:
    none, number = np.zeros(0, dtype=np.int64), np.zeros(0)
    return Pairs(none, none, number, number, number, none, number)


def _expected(seen: Ints, expected: Ints, both: Ints, a: Ints, b: Ints) -> Floats:
    """Return the number of frames (P,) in which both objects would be detected, if their detections are independent.

    seen, expected: (N,) the number of frames that show each object, and that should show it. both: (P,) the number of frames
    with both objects in view. a, b: (P,) the objects of each pair.
    """
    rate = seen / np.maximum(expected, 1)
    return np.asarray(both * rate[a] * rate[b])


def _density(position: Floats, label: Ints, wanted: Ints, labels: int) -> Floats:
    """Return the number of objects per cubic metre (P,) of each wanted label (P,), in the space that all objects take."""
    volume = float((np.ptp(position, axis=0) + 2 * _PAD).prod())
    return np.asarray(np.bincount(label, minlength=labels)[wanted] / volume)
