"""Find objects that are one thing at several places. The thing stood at one place, moved, and stood at another.

A thing at rest is seen whenever its place is in view. After a thing has moved away, its old place is in view without it."""

from itertools import product

import numpy as np

from objslam.association.landmarks import State
from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.result import Doubt, RunResult
from objslam.mapping.moves.driven_through import first_names

_FACTOR = 3
"""The least number of frames with a place in view without its thing, as a multiple of the largest such number of any object
of another label. Walls cause such frames too, because no box shows a wall that hides a thing. In a home of two rooms, clocks
had 1.0 and 1.2 times this number. A simulated robot that stood at two places had 11 and 13 times. With a larger multiple,
fewer things are named."""
_FRAMES = 10
"""The least number of frames with a place in view without its thing. With a larger number, fewer things are named."""
_OTHERS = 5
"""The fewest objects of other labels with which an object can be compared. With a larger number, fewer maps are judged."""
_BESIDE, _BEHIND = np.cos(np.radians(20.0)), 0.9
"""The limits for a thing that shows that a camera sees past a place. `_BESIDE` is the cosine of the largest angle between
the directions to the thing and to the place. `_BEHIND` is the least distance of the thing, as a share of the place's
distance. If the camera detects such a thing, no wall hides the place, unless the wall ends between the two. With a smaller
angle or a larger share, fewer frames count."""
_USUAL = 0.9
"""The quantile, over the objects, of the most frames that see past an object between two consecutive boxes of it. Objects
above the quantile may be several things, or may have moved. In a simulated room, six of 27 things moved. The quantile was 7
frames, and the cameras saw past the places of the moved things in 11 to 48 frames. With a larger quantile, fewer things are
named."""

Without = tuple[Ints, Ints, Ints, Ints]
"""Four arrays (N,), one value for each object. The first two are the numbers of frames with the object's place in view:
before its first box, and after its last box. The other two are the frames of the first and of the last box, -1 for an object
without a box."""


def at_other_places(result: RunResult, state: State, objects: Ints) -> list[Doubt]:
    """Return a doubt for each pair of objects of one label that is likely one thing that moved.

    The first object was last seen before the second object was first seen. The place of the first object came into view
    later, without it. The place of the second object had been in view before, without it. state: the state of N objects.
    objects: (N,) the indices of the objects in the map.
    """
    if not len(objects):
        return []
    history = state.history
    map_objects = [result.map.objects[j] for j in objects.tolist()]
    label = np.unique([o.label for o in map_objects], return_inverse=True)[1]
    pairs = {*_pairs(history, label), *_pairs_seen_past(state, label)}
    in_view = _without(history, np.ones(len(history.frame), dtype=bool))
    found = []
    for a, b in _nearest_first(pairs, np.array([o.position for o in map_objects])):
        one, two = map_objects[a], map_objects[b]
        after, before = int(in_view[1][a]), int(in_view[0][b])
        found.append(
            Doubt(
                "pair",
                "moved",
                one.label,
                f"{one.label} #{one.id} and #{two.id} are likely one thing that moved: after its last box, the place of "
                f"#{one.id} was in view in {after} frames, and before its first box, the place of #{two.id} in {before}.",
                (one.id, two.id),
                (one.position + two.position) / 2,
                np.flatnonzero(np.isin(result.association.object, objects[[a, b]])),
                {"frames_after": float(after), "frames_before": float(before)},
            )
        )
    return found


def _nearest_first(pairs: set[tuple[int, int]], position: Floats) -> list[tuple[int, int]]:
    """Return the pairs that are left if no object may leave twice or come twice. Near pairs are preferred to far ones.

    position: (N, 3) m.
    """
    chosen: list[tuple[int, int]] = []
    for a, b in sorted(pairs, key=lambda pair: (float(np.linalg.norm(position[pair[0]] - position[pair[1]])), pair)):
        if all(a != left and b != came for left, came in chosen):
            chosen.append((a, b))
    return sorted(chosen)


def _pairs(history: DetectionHistory, label: Ints) -> list[tuple[int, int]]:
    """Return the pairs of objects whose places are in view without them for far more frames than those of objects of other
    labels."""
    without = _without(history, np.ones(len(history.frame), dtype=bool))
    return _left_and_came(without, label, _FACTOR * _largest_of_others(np.maximum(*without[:2]), label))


def _pairs_seen_past(state: State, label: Ints) -> list[tuple[int, int]]:
    """Return the pairs of objects past whose places cameras see, without the objects, in far more frames than for things at
    rest.

    If things of two labels moved, or a thing was taken away, no pair differs clearly from all objects of other labels. But a
    thing is at rest between its first and its last box. So the misses between its boxes show in how many frames things at
    rest are missed.
    """
    history, past = state.history, _seen_past(state, label)
    without = _without(history, past)
    usual = np.quantile(_longest_misses(history, past, *without[2:]), _USUAL)
    return _left_and_came(without, label, np.full(len(label), _FACTOR * usual))


def _longest_misses(history: DetectionHistory, counts: Bools, first: Ints, last: Ints) -> Ints:
    """Return the most frames (N,) without each object between two consecutive boxes of it. counts: (V,) a mask of the
    entries of the history that count."""
    between = counts & (history.frame > first[history.object]) & (history.frame < last[history.object])
    missed = np.flatnonzero(between & ~history.detected)
    box_before = np.cumsum(history.detected)  # The pairs are sorted by object, so it is a box of the same object.
    longest = np.zeros(len(first), dtype=np.int64)
    np.maximum.at(longest, history.object[missed], np.bincount(box_before[missed])[box_before[missed]])
    return longest


def _left_and_came(without: Without, label: Ints, least: Floats | Ints) -> list[tuple[int, int]]:
    """Return the pairs of objects of one label in which the first object left before the second one came.

    least: (N,) the least number of frames with the place of each object in view after it left, or before it came. Fewer than
    `_FRAMES` frames are never enough. An object needs `_OTHERS` objects of other labels.
    """
    before, after, first, last = without
    judged = (first >= 0) & (len(label) - np.bincount(label)[label] >= _OTHERS)
    left, came = (np.flatnonzero(judged & (frames >= np.maximum(_FRAMES, least))) for frames in (after, before))
    return [(a, b) for a, b in product(left.tolist(), came.tolist()) if label[a] == label[b] and last[a] < first[b]]


def _seen_past(state: State, label: Ints) -> Bools:
    """Return a mask (V,) of the entries of the history without a box in which the camera sees past the place of the object.

    A thing of the same label does not count, because its box may be of the object itself.
    """
    history, origin = state.history, state.view.map_T_camera[:, :3, 3]
    toward = state.landmarks.position[history.object] - origin[history.frame]
    away = np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    toward = toward / away[:, None]
    detected = np.flatnonzero(history.detected)
    detected = detected[np.argsort(history.frame[detected], kind="stable")]
    begin, end = (np.searchsorted(history.frame[detected], history.frame, side=side) for side in ("left", "right"))
    past = np.zeros(len(history.frame), dtype=bool)
    missed = np.flatnonzero(~history.detected)
    for k in range(int((end - begin).max(initial=0))):  # Each step compares with the k-th thing of all frames that have one.
        rows = missed[end[missed] - begin[missed] > k]
        other = detected[begin[rows] + k]
        beside = np.einsum("vi,vi->v", toward[rows], toward[other]) >= _BESIDE
        beside &= (away[other] >= _BEHIND * away[rows]) & (label[history.object[other]] != label[history.object[rows]])
        past[rows] |= beside
    return past


def _largest_of_others(value: Ints, label: Ints) -> Ints:
    """Return the largest value (N,) among the objects of other labels, 0 if there are none. value, label: (N,)."""
    largest = np.zeros(label.max() + 1, dtype=np.int64)
    np.maximum.at(largest, label, value)
    order = np.argsort(-largest, kind="stable")
    others = np.full(len(largest), largest[order[0]])
    others[order[0]] = largest[order[1]] if len(order) > 1 else 0
    return np.asarray(others[label])


def _without(history: DetectionHistory, counts: Bools) -> Without:
    """Return the frames without each object, as in `Without`. counts: (V,) a mask of the entries of the history that
    count."""
    count = len(history.inside)
    seen = history.detected
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(first, history.object[seen], history.frame[seen])
    np.maximum.at(last, history.object[seen], history.frame[seen])
    first = np.where(last < 0, -1, first)
    some = counts & (last[history.object] >= 0)
    before = np.bincount(history.object[some & (history.frame < first[history.object])], minlength=count)
    after = np.bincount(history.object[some & (history.frame > last[history.object])], minlength=count)
    return before, after, first, last


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence of the assessment about these objects, as a list that is empty without doubts."""
    if not doubts:
        return []
    pairs = first_names([f"{one.label} #{one.objects[0]} and #{one.objects[1]}" for one in doubts])
    return [f"Likely one thing that moved: {pairs}. Each place was in view without it (`objslam explain`)."]
