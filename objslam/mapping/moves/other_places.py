"""Objects that are one thing at several places: it stood at one place, moved, and stood at another.

A thing at rest is seen whenever it is in view. One that has moved away is in view no longer: its old place is, without it.
"""

from itertools import product

import numpy as np

from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Ints
from objslam.core.result import Doubt, RunResult
from objslam.mapping.moves.driven_through import first_names

_FACTOR = 3
"""A place without its thing must be in view in this multiple of the frames of any object of another label. Walls hide things
too, because no box shows a wall: in a home of two rooms, clocks came to 1.0 and 1.2 times, and a simulated robot that stood
at two places came to 11 and 13 times. With a larger number, fewer things are named."""
_FRAMES = 10
"""The least number of frames with a place without its thing. With a larger number, fewer things are named."""
_OTHERS = 5
"""The least number of objects of other labels to compare with. With a larger number, fewer maps are judged."""


def at_other_places(result: RunResult, history: DetectionHistory, objects: Ints) -> list[Doubt]:
    """Return a doubt for each pair of objects of one label that is likely one thing that moved.

    The first object was seen for the last time before the second one was seen first. Its place came into view later, and
    the place of the second one had been in view before. history: of N objects. objects: (N,) their indices in the map.
    """
    if not len(objects):
        return []
    before, after, first, last = _without(history)
    map_objects = [result.map.objects[j] for j in objects.tolist()]
    label = np.unique([o.label for o in map_objects], return_inverse=True)[1]
    least = np.maximum(_FRAMES, _FACTOR * _largest_of_others(np.maximum(before, after), label))
    seen = (first >= 0) & (len(label) - np.bincount(label)[label] >= _OTHERS)
    left, came = np.flatnonzero(seen & (after >= least)), np.flatnonzero(seen & (before >= least))
    found = []
    for a, b in product(left.tolist(), came.tolist()):
        if label[a] != label[b] or last[a] >= first[b]:
            continue
        one, two = map_objects[a], map_objects[b]
        found.append(
            Doubt(
                "pair",
                "moved",
                one.label,
                f"{one.label} #{one.id} and #{two.id} are likely one thing that moved: after its last box, the place of "
                f"#{one.id} was in view in {after[a]} frames, and before its first box, the place of #{two.id} in "
                f"{before[b]}.",
                (one.id, two.id),
                (one.position + two.position) / 2,
                np.flatnonzero(np.isin(result.association.object, objects[[a, b]])),
                {"frames_after": float(after[a]), "frames_before": float(before[b])},
            )
        )
    return found


def _largest_of_others(value: Ints, label: Ints) -> Ints:
    """Return the largest value (N,) among the objects of other labels, 0 if there are none. value, label: (N,)."""
    largest = np.zeros(label.max() + 1, dtype=np.int64)
    np.maximum.at(largest, label, value)
    order = np.argsort(-largest, kind="stable")
    others = np.full(len(largest), largest[order[0]])
    others[order[0]] = largest[order[1]] if len(order) > 1 else 0
    return np.asarray(others[label])


def _without(history: DetectionHistory) -> tuple[Ints, Ints, Ints, Ints]:
    """Return four arrays (N,): the frames with an object's place in view before its first box, and after its last box, and
    the frames of these boxes. The frames of an object without a box are -1."""
    count = len(history.inside)
    seen = history.detected
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(first, history.object[seen], history.frame[seen])
    np.maximum.at(last, history.object[seen], history.frame[seen])
    first = np.where(last < 0, -1, first)
    some = last[history.object] >= 0
    before = np.bincount(history.object[some & (history.frame < first[history.object])], minlength=count)
    after = np.bincount(history.object[some & (history.frame > last[history.object])], minlength=count)
    return before, after, first, last


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence about the objects for the assessment."""
    if not doubts:
        return []
    pairs = first_names([f"{one.label} #{one.objects[0]} and #{one.objects[1]}" for one in doubts])
    return [f"Likely one thing that moved: {pairs}. Each place was in view without it (`objslam explain`)."]
