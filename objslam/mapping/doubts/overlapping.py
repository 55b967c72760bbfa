"""Doubts about pairs of objects whose bodies fill one space, which two things cannot do."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools
from objslam.core.bodies.upright_box import UprightBox, overlap
from objslam.core.object_map import MapObject
from objslam.core.result import Doubt, RunResult
from objslam.mapping.doubts.pairs import Pairs

_SAME = 0.3
"""The least intersection over union of two bodies of one label that are doubted. Bodies of neighbours that are too large
overlap by less. A larger value finds fewer doubles."""
_OTHER = 0.5
"""The least intersection over union of two bodies of different labels that are doubted. A thing may stand on another one, or
in it. A larger value finds fewer things with two labels."""
_BOTH = 2
"""The most keyframes with boxes of both objects of a doubted pair. In these keyframes, a detector may show one thing twice.
A larger number finds more doubles, and doubts more neighbours whose bodies are too large."""
_MOST = 2000
"""The most objects with a body whose pairs are compared. In maps with more objects, only `find_pairs` compares pairs, by
their rays."""


def overlapping(result: RunResult, pairs: Pairs) -> list[Doubt]:
    """Return a doubt for each pair of objects whose bodies overlap, without the pairs that are doubted already.

    If several frames show both objects, they are two things whose bodies are too large. Such a pair gets no doubt.
    """
    known = {frozenset(pair) for pair in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)}
    objects = result.map.objects
    bodies = [j for j, one in enumerate(objects) if one.status == "ok" and one.body is not None]
    if not 1 < len(bodies) <= _MOST:
        return []
    place, reach = np.array([objects[j].position for j in bodies]), np.array([_reach(objects[j]) for j in bodies])
    near = np.linalg.norm(place[:, None] - place, axis=2) < reach[:, None] + reach
    found = []
    for a, b in np.argwhere(np.triu(near, 1)).tolist():
        j, k = bodies[a], bodies[b]
        if frozenset((j, k)) in known:
            continue
        share, same = overlap(_box(objects[j]), _box(objects[k])), objects[j].label == objects[k].label
        if share >= (_SAME if same else _OTHER) and _together(result, j, k) <= _BOTH:
            found.append(_in_words(objects[j], objects[k], share, np.isin(result.association.object, [j, k])))
    return found


def _together(result: RunResult, j: int, k: int) -> int:
    """Return the number of keyframes with boxes of both objects."""
    one, other = (result.rays.keyframe[result.association.object == i] for i in (j, k))
    return len(np.intersect1d(one, other))


def _reach(one: MapObject) -> float:
    assert one.body is not None
    return float(np.linalg.norm(one.body.size) / 2)


def _box(one: MapObject) -> UprightBox:
    assert one.body is not None
    return one.position, one.body.size, one.body.yaw


def _in_words(a: MapObject, b: MapObject, share: float, rays: Bools) -> Doubt:
    what = "one thing" if a.label == b.label else "one thing with two labels"
    return Doubt(
        "pair",
        "bodies overlap",
        a.label,
        f"{a.label} #{a.id} and {b.label} #{b.id} may be {what}: their bodies overlap by {100 * share:.0f} %, and two "
        "things cannot fill one space.",
        (a.id, b.id),
        (a.position + b.position) / 2,
        np.flatnonzero(rays),
        {"overlap": share, "distance_m": float(np.linalg.norm(a.position - b.position))},
    )
