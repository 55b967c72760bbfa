"""Doubts about objects that may be several things, or no thing. Their rays do not agree with one point, or the rays of two
things cross, or too few of the frames that should show them do."""

from __future__ import annotations

import numpy as np

from objslam.association.crossings.one_or_two import find_crossings
from objslam.core.result import Doubt, RunResult
from objslam.core.statistics import logistic
from objslam.mapping.checks.misfits import Misfits, find_misfits
from objslam.mapping.doubts.evidence import Evidence

_NAMED = 3
"""The most objects that the assessment names. A larger number makes the assessment longer."""
_ONE_THING = 0.5
"""The probability of being one thing below which an object is doubted. It concerns objects at which the rays of two things
may cross. With a larger value, fewer maps are good."""
RARELY_SEEN = "rarely seen"
"""The reason of a doubt about an object that too few frames show."""
_EXISTS = 0.8
"""The existence below which an object is doubted. It was chosen from 18 runs on twelve simulated flats: 11 of 14 objects
below it were false, and two of the other three were inside their 95 % ellipsoids. Of 14 objects with 0.8 to 0.9, two were
false. In a recorded office, 8 of 40 objects were below it: among them a refrigerator that is none and a second bottle at
one place, but also a real monitor. With a larger value, more objects are doubted."""


def misfits_of(result: RunResult) -> Misfits:
    """Return how well the rays of each object of a result agree."""
    held = result.keyframes, result.rays, result.association
    return find_misfits(result.map, *held, result.residual, result.weight, result.settings)


def disagreeing(result: RunResult, misfits: Misfits) -> list[Doubt]:
    """Return a doubt for each object whose rays do not agree, the worst first."""
    odd = np.flatnonzero(misfits.odd)
    found = []
    for j in odd[np.argsort(-misfits.times[odd], kind="stable")].tolist():
        o, times = result.map.objects[j], float(misfits.times[j])
        found.append(
            Doubt(
                "split",
                "rays disagree",
                o.label,
                f"{o.label} #{o.id} may be several things, or its boxes show parts of it: its rays miss it by {times:.1f} "
                f"times their noise, and the rays of most objects by {misfits.usual:.1f} times. Its sigma allows for this.",
                (o.id,),
                o.position,
                np.flatnonzero(result.association.object == j),
                {"misfit": times, "usual_misfit": misfits.usual},
            )
        )
    return found


def crossing(result: RunResult, evidence: Evidence) -> list[Doubt]:
    """Return a doubt for each object that is probably not one thing at its place, the most probable first.

    The rays of such an object come from two sides. Two things whose rays cross at the object explain the rays too. The
    association splits such an object only if it is clearly two things, because a split may lose a thing. The association
    also allows for more noise than the solved poses have. Frames that should show the object, but do not, make it less
    probable that the object is one thing (`existence`).
    """
    state = evidence.state
    sized = np.array([camera.sees_size for camera in result.cameras], dtype=bool)
    if not state.count or not sized.any():
        return []
    found = find_crossings(state, sized[result.keyframes.camera[result.rays.keyframe[evidence.ray]]], fewest=1)
    objects = [result.map.objects[j] for j in evidence.object[found.landmark].tolist()]
    one = logistic(found.odds) * np.array([1.0 if o.existence is None else o.existence for o in objects])
    doubts = []
    for s in np.argsort(one, kind="stable")[: int((one < _ONE_THING).sum())].tolist():
        o, mine = objects[s], state.matched == found.landmark[s]
        second, number = int((found.second & mine).sum()), int(mine.sum())
        doubts.append(
            Doubt(
                "split",
                "crossing",
                o.label,
                f"{o.label} #{o.id} may be where the rays of two things cross: {number - second} of its rays come from one "
                f"side, and {second} from another. The rays, the sizes of their boxes, and frames without a box give a "
                f"probability of {one[s]:.2g} that it is one thing.",
                (o.id,),
                o.position,
                evidence.ray[np.flatnonzero(mine)],
                {
                    "probability": 1 - float(one[s]),
                    "log_odds": -float(found.odds[s]),
                    "rays": number - second,
                    "other_rays": second,
                },
            )
        )
    return doubts


def rarely_seen(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object with a position whose existence is low, the lowest first."""
    found = []
    for j, o in enumerate(result.map.objects):
        if o.status != "ok" or o.existence is None or o.existence >= _EXISTS:
            continue
        found.append(
            Doubt(
                "split",
                RARELY_SEEN,
                o.label,
                f"{o.label} #{o.id} may be no thing, but a place where rays of several things meet: too few of the frames "
                f"that should show it do. The probability that it exists is {o.existence:.2g}.",
                (o.id,),
                o.position,
                np.flatnonzero(result.association.object == j),
                {"existence": o.existence, "rays": o.rays},
            )
        )
    return sorted(found, key=lambda one: one.numbers["existence"])


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence about the objects for the assessment."""
    if not doubts:
        return []
    names = list(dict.fromkeys(f"{one.label} #{one.objects[0]}" for one in doubts))
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    one = len(names) == 1
    many = "1 object has" if one else f"{len(names)} objects have"
    what = "it may be several things, or at a wrong place" if one else "each may be several things, or at a wrong place"
    return [f"{many} rays that do not agree on one thing ({', '.join(names[:_NAMED])}{more}): {what}."]


def rare_in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentence about rarely seen objects for the assessment."""
    if not doubts:
        return []
    names = [f"{one.label} #{one.objects[0]}" for one in doubts]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    named = f"({', '.join(names[:_NAMED])}{more})"
    if len(names) == 1:
        return [f"1 object is missing in too many frames that should show it {named}: it may be no thing."]
    return [f"{len(names)} objects are missing in too many frames that should show them {named}: each may be no thing."]
