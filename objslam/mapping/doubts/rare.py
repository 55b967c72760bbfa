"""Doubts about objects that may be no thing, because too few of the frames that should show them do."""

from __future__ import annotations

import numpy as np

from objslam.core.result import Doubt, RunResult

_EXISTS = 0.8
"""The existence below which an object is doubted. In 18 runs on twelve simulated flats, 13 of 17 such objects were false,
and three of the other four were outside their 95 % ellipsoids. Of 15 objects with 0.8 to 0.9, three were false. In a
recorded office, 8 of 40 objects were below it: among them a refrigerator that is none and a second bottle at one place, but
also a real monitor. With a larger value, more objects are doubted."""
_NAMED = 3
"""The most objects that the assessment names. A larger number makes the assessment longer."""


def rarely_seen(result: RunResult) -> list[Doubt]:
    """Return a doubt for each object with a position whose existence is low, the lowest first."""
    found = []
    for j, o in enumerate(result.map.objects):
        if o.status != "ok" or o.existence is None or o.existence >= _EXISTS:
            continue
        found.append(
            Doubt(
                "split",
                "rarely seen",
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
    names = [f"{one.label} #{one.objects[0]}" for one in doubts]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    named = f"({', '.join(names[:_NAMED])}{more})"
    if len(names) == 1:
        return [f"1 object is missing in too many frames that should show it {named}: it may be no thing."]
    return [f"{len(names)} objects are missing in too many frames that should show them {named}: each may be no thing."]
