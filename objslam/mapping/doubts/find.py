"""Find all doubts about a result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.result import DOUBT_KINDS, LIKELY, Doubt, RunResult, doubtful_ids
from objslam.core.statistics import grouped_median
from objslam.mapping.doubts import cut_things as cut_off
from objslam.mapping.doubts import disagreeing as apart
from objslam.mapping.doubts import unsure as wide
from objslam.mapping.doubts.evidence import Evidence, evidence_of
from objslam.mapping.doubts.groups import REASONS, BoxGroups, Reason, find_groups
from objslam.mapping.doubts.overlapping import overlapping
from objslam.mapping.doubts.pairs import Pairs, find_pairs
from objslam.mapping.doubts.sizes import mixed_sizes
from objslam.mapping.doubts.splits import Splits, find_splits
from objslam.mapping.doubts.twice import find_twice
from objslam.mapping.doubts.unmapped import in_assessment, unmapped_labels
from objslam.mapping.doubts.words import in_place, in_words
from objslam.mapping.moves import driven_through as passed
from objslam.mapping.moves import other_places as moved
from objslam.mapping.moves import temporary_things as temporary

_DOUBTFUL = 0.4
"""The least share of doubtful objects in a bad map. A doubtful object is likely a double, or may be several things or at a
wrong place. In simulation, two maps with mostly wrong objects had 0.44 and 0.47, and right maps had at most 0.15. A third
wrong map, whose settings said that the poses are noisy, had 0.09, so a low share is no proof. Two maps with a right path and
a fifth to a third of false objects had 0.29 and 0.34. With a larger share, fewer maps are bad."""
_FEWEST_DOUBTFUL = 8
"""The fewest doubtful objects of a bad map. With a larger number, fewer small maps are bad."""
_DOUBLES = 0.2
"""The least share of objects that are likely doubles, or that some visits do not show, in a map whose poses are likely
wrong. Two streets had 0.33 and 0.41 at places of a GPS that wanders by half a metre. After a solve of the poses, a street
with 20 cars that parked for a time had 0.13. An orchard had 0.02. With a larger share, fewer logs get a solve of the
poses."""
_LOST = (0.1, 0.5)
"""The shares of boxes from which a group that became no object counts in the assessment. The group counts if it has at least
the first share of all boxes of its label. It also counts if it has at least the second share of the median number of boxes
of an object of its label. False boxes of a detector at one place are usually fewer. With larger shares, more maps are
good."""
_MARKED = 1 / 20
"""At a localisation, the level of a map does not change up to this share of doubtful things. Doubtful objects are a share of
all objects, and lost things are a share of all things. `doubts.json` and the report still mark them. Each object is tested
by itself, so a large right map often has a doubtful object. In simulated homes, doubts name about half of the objects that
are false or over 3 sigma off. So in a map with a tenth of such objects, about this share is doubted. With a larger share,
more maps are good."""
_FEWEST_LOST = 5
"""The fewest boxes of a group that counts in the assessment. With a larger number, more maps are good."""
_AT_REST = 0.5
"""If a label has no placed object, its lost things count in the assessment only if they have at least this share of the
label's boxes. Below this share, most boxes fit no place, as the boxes of another robot that sometimes stops. The assessment
names such a label in any case. With a larger share, more maps are good."""
_VIEWS = (3, np.radians(10.0))
"""The fewest views of a lost thing that counts although few of the frames show it, and the least angle (rad) between two
views. A detector repeats a false box while it sees a place from one view. Two false views cross somewhere, so the third view
is the first that confirms the place. The angle is explained at `mapping.box_offsets.ANGLES`. With more views, more maps are
good."""
_PLACED: tuple[Reason, ...] = ("rare", "size", "unclear")
"""The reasons of groups whose boxes agree on one place at rest, and more closely than by chance."""
_MOVED: tuple[Reason, ...] = ("moves",)
"""The reasons of groups whose thing seems to move. The assessment names these things, but a map may lack things that
move."""


@dataclass(frozen=True)
class Doubts:
    """The doubts about a result: pairs of objects that may be one, objects that may be two, and groups of boxes that became
    no object."""

    pairs: Pairs
    splits: Splits
    groups: BoxGroups


def find_doubts(result: RunResult, evidence: Evidence) -> Doubts:
    """Return the doubts about a result. evidence: the evidence of this result."""
    return Doubts(find_pairs(evidence), find_splits(evidence), find_groups(evidence, result.settings))


def with_doubts(result: RunResult) -> RunResult:
    """Return the result with its doubts in words, and their counts by kind in the summary.

    A map is not called good in three cases, which may concern its whole path: some objects are more likely doubles than not,
    a place is in the map twice, or most objects have a wide sigma.

    A map is also not called good if too many things are doubtful (`_are_few`). A thing counts if the rays of an object do
    not agree on one thing, if too few frames show an object, if an object has many sizes, or if the robot drove through an
    object. It counts if two objects
    are likely one thing that moved, or if many boxes of a label meet where the map has no object. If few things count, the
    assessment only names them.

    The assessment also names labels without an object, things that have only cut off boxes, and things that seem to move.
    They do not change its level, because their boxes may be false, and because no map contains things that move. A map is
    bad if many objects are doubtful (`mostly_doubtful`).
    """
    evidence = evidence_of(result)
    found = find_doubts(result, evidence)
    filling = overlapping(result, found.pairs)
    doubts = (*filling, *in_words(result, found.pairs, found.splits, found.groups))
    cut = cut_off.cut_things(result)
    unmapped, told = unmapped_labels(result, evidence, cut), {one.label for one in doubts if one.kind == "boxes"}
    disagreeing = [*apart.crossing(result, evidence), *apart.disagreeing(result, apart.misfits_of(result))]
    called = {one.objects for one in (*doubts, *disagreeing) if one.kind == "split"}
    rare = [one for one in apart.rarely_seen(result) if one.objects not in called]
    through = passed.driven_through(result)
    paired = {one.objects for one in doubts if one.kind == "pair"}
    elsewhere = moved.at_other_places(result, evidence.state, evidence.object)
    elsewhere = [one for one in elsewhere if one.objects not in paired and one.objects[::-1] not in paired]
    paired |= {one.objects for one in elsewhere}
    for_a_time = temporary.there_for_a_time(result, evidence.state, evidence.object, {j for pair in paired for j in pair})
    mixed, unsure = mixed_sizes(result), wide.unsure_objects(result)
    # If a whole label has no object, its doubt is enough. Its things get no doubts of their own.
    lacking = {one.label for one in unmapped}
    cut = [thing for thing in cut if result.rays.label_names[thing.label] not in lacking]
    of_things = [
        *unsure,
        *cut_off.in_doubts(cut, result),
        *_unnamed(disagreeing, doubts),
        *rare,
        *through,
        *elsewhere,
        *for_a_time,
        *mixed,
    ]
    doubts = (*doubts, *of_things, *(one for one in unmapped if one.label not in told))
    counts: dict[str, int] = {kind: sum(one.kind == kind for one in doubts) for kind in DOUBT_KINDS}
    summary = {**result.summary, "doubts": counts}
    doubtful = _doubtful_objects(doubts, result)
    summary["doubtful_objects"] = doubtful
    doubles = int((found.pairs.probability >= LIKELY).sum()) + sum(_of_one_label(one, result) for one in filling)
    if "assessment" in summary:
        lost, named = _of_lost_things(found.groups, result), wide.in_assessment(unsure, result)
        odd = {j for one in (*disagreeing, *rare, *mixed, *through, *elsewhere) for j in one.objects}
        few = _are_few(len(odd), len(lost), result)
        lost = [*apart.rare_in_assessment(rare), *lost]
        if wide.are_most(unsure, result):
            lost, named, few = [*named, *lost], [], False
        twice = find_twice(result.map)
        whole = [*([twice.in_words()] if twice else []), *_of_doubles(doubles)]
        of_objects = [*passed.in_assessment(through), *moved.in_assessment(elsewhere)]
        of_objects += [*apart.in_assessment(disagreeing), *_of_mixed(len(mixed))]
        assessment = _assessed(summary["assessment"], *((whole, []) if few else ([*whole, *of_objects], lost)))
        if few:
            assessment = _praised(assessment, len(odd), len(result.map.resolved()))
            named = [*of_objects, *lost, *named]
        named += [*temporary.in_assessment(for_a_time)]
        named += [*_of_moved_things(found.groups, result), *in_assessment(unmapped), *cut_off.in_assessment(cut, result)]
        summary["assessment"] = {**assessment, "reasons": [*assessment["reasons"], *named]}
        if mostly_doubtful(replace(result, summary=summary)):
            reasons = [_of_doubtful(doubtful, result), *summary["assessment"]["reasons"]]
            summary["assessment"] = {"level": "bad", "reasons": reasons}
    return replace(result, doubts=doubts, summary=summary)


def mostly_doubtful(result: RunResult) -> bool:
    """Return whether so many objects of a result with its doubts are doubtful that its map is bad."""
    return bool(result.summary["doubtful_objects"] >= max(_FEWEST_DOUBTFUL, _DOUBTFUL * len(result.map.resolved())))


def maps_things_twice(result: RunResult) -> bool:
    """Return whether so many things of a result with its doubts are likely in the map twice that its poses are likely wrong.

    At poses that err for seconds, a thing gets an object for each visit. Two such objects are doubtful as a pair, or other
    visits do not show them. Wrong poses also put whole places into the map twice (`find_twice`).
    """
    moved = [one for one in result.doubts if "moved" in (one.kind, one.reason)]
    pairs = [one for one in result.doubts if one.kind == "pair" and one.numbers.get("probability", 0.0) >= LIKELY]
    doubles = {j for one in (*moved, *pairs) for j in one.objects}
    many = max(_FEWEST_DOUBTFUL, _DOUBLES * len(result.map.resolved()))
    return len(doubles) >= many or find_twice(result.map) is not None


def _doubtful_objects(doubts: tuple[Doubt, ...], result: RunResult) -> int:
    """Return the number of objects with a position that are likely doubles, or may be several things or at a wrong place.

    Objects that too few frames show do not count, because many of them are no sign of wrong poses or exchanged boxes.
    """
    named = doubtful_ids((one for one in doubts if one.reason != apart.RARELY_SEEN), ("pair", "split"))
    return sum(one.id in named for one in result.map.resolved())


def _of_doubtful(doubtful: int, result: RunResult) -> str:
    many = f"{doubtful} of {len(result.map.resolved())} objects are doubtful"
    if result.settings.mode == "fixed" and result.keyframes.localized_every:
        said = result.settings.localization
        return (
            f"{many}: the poses are likely worse than localization.xy ({said.xy:g} m) and localization.yaw "
            f"({np.degrees(said.yaw):.2g} deg) say, so one thing is at several places. --mode joint solves the poses too."
        )
    return f"{many}: boxes of equal things were likely exchanged. Depths, track ids, or more labels would tell them apart."


def _are_few(odd: int, lost: int, result: RunResult) -> bool:
    """Return whether the doubts about `odd` objects and `lost` things are too few to change the level of the map.

    From odometry alone, the doubts are never too few: a false object bends the path, which moves all other objects. At a
    localisation, a false object moves no other object.
    """
    known = len(result.map.resolved())
    localized = bool(result.keyframes.localized_every)
    return localized and odd <= _MARKED * known and lost <= _MARKED * (known + lost)


def _of_one_label(doubt: Doubt, result: RunResult) -> bool:
    """Return whether all objects of a doubt have the same label. Other objects are no doubles: one may stand on the other or
    in it."""
    return len({one.label for one in result.map.objects if one.id in doubt.objects}) == 1


def _assessed(assessment: dict[str, Any], doubles: list[str], lost: list[str]) -> dict[str, Any]:
    """Return the assessment with more reasons for a look at the map. `doubles` come first, and `lost` comes last."""
    if assessment["level"] == "bad" or not (doubles or lost):
        return assessment
    if assessment["level"] == "good":  # The first reason praises the map. The others only describe it.
        return {**assessment, "level": "check", "reasons": [*doubles, *lost, *assessment["reasons"][1:]]}
    return {**assessment, "reasons": [*doubles, *assessment["reasons"], *lost]}


def _praised(assessment: dict[str, Any], odd: int, count: int) -> dict[str, Any]:
    """Return a good assessment that does not praise the `odd` doubtful objects of `count`."""
    if assessment["level"] != "good" or not odd:
        return assessment
    praise = f"{count} objects, {odd} of them doubtful. The boxes of the others agree to within the expected noise."
    return {**assessment, "reasons": [praise, *assessment["reasons"][1:]]}


def _unnamed(found: list[Doubt], earlier: tuple[Doubt, ...]) -> list[Doubt]:
    """Return the first of the doubts `found` about each object. Objects with a doubt of the kind "split" in `earlier` are
    left out."""
    called = {one.objects for one in earlier if one.kind == "split"}
    first: dict[tuple[int, ...], Doubt] = {}
    for one in found:
        first.setdefault(one.objects, one)
    return [one for objects, one in first.items() if objects not in called]


def _of_mixed(mixed: int) -> list[str]:
    if mixed == 1:
        return ["1 object has boxes of very different sizes, so it may be several things: `objslam explain` names it."]
    many = f"{mixed} objects have boxes of very different sizes, so each may be several things"
    return [f"{many}: `objslam explain` names them."] if mixed else []


def _of_doubles(doubles: int) -> list[str]:
    if doubles == 1:
        return ["1 object may be a double of a neighbour: `objslam explain` names it."]
    return [f"{doubles} objects may be doubles of neighbours: `objslam explain` names them."] if doubles else []


def _of_lost_things(groups: BoxGroups, result: RunResult) -> list[str]:
    """Return a reason for each label with a lost thing: many boxes of the label meet in one place, but the map has no object
    there."""
    if not len(groups):
        return []
    placed = np.isin(groups.reason, [REASONS.index(reason) for reason in _PLACED])
    at_rest = np.bincount(groups.label[groups.group][placed[groups.group]], minlength=len(result.rays.label_names))
    mapped = np.isin(result.rays.label_names, [one.label for one in result.map.resolved()])
    counts = mapped | (at_rest >= _AT_REST * np.bincount(result.rays.label, minlength=len(mapped)))
    rare = np.flatnonzero(groups.reason == REASONS.index("rare"))
    few = [g for g in rare.tolist() if not _has_views(result.directions[groups.ray[groups.group == g]])]
    return [
        f"{told} fit no object, but meet in one place near {in_place(place)}: a thing may be missing (`objslam explain`)."
        for g, told, place in _large_groups(groups, result, _PLACED)
        if counts[groups.label[g]] and g not in few
    ]


def _has_views(direction: Floats) -> bool:
    """Return whether unit directions (N, 3) contain at least the number of views in `_VIEWS`."""
    least, angle = _VIEWS
    for _ in range(least - 1):
        direction = direction[direction @ direction[0] < np.cos(angle)] if len(direction) else direction
    return len(direction) > 0


def _of_moved_things(groups: BoxGroups, result: RunResult) -> list[str]:
    """Return a reason for each large group whose thing seems to move and is no object of the map."""
    return [
        f"{told} fit no object, and the thing near {in_place(place)} seems to move (`objslam explain`)."
        for _, told, place in _large_groups(groups, result, _MOVED)
    ]


def _large_groups(groups: BoxGroups, result: RunResult, reasons: tuple[Reason, ...]) -> list[tuple[int, str, Floats]]:
    """Return the index, a phrase and the place (3,) of each large group with one of the reasons. The phrase says how many
    boxes of its label the group has."""
    if not len(groups):
        return []
    labels = result.rays.label_names
    every = np.bincount(result.rays.label, minlength=len(labels))
    number = np.bincount(groups.group, minlength=len(groups))
    wanted = np.isin(groups.reason, [REASONS.index(reason) for reason in reasons])
    held = np.bincount(result.association.object[result.association.object >= 0], minlength=result.association.count)
    usual = grouped_median(held.astype(np.float64), result.association.label, len(labels))
    least = np.fmin(_LOST[0] * every, _LOST[1] * usual)  # A label without an object has no usual number.
    large = wanted & (number >= np.maximum(_FEWEST_LOST, least[groups.label]))
    return [
        (g, f"{number[g]} of {every[groups.label[g]]} boxes of {labels[groups.label[g]]!r}", groups.position[g])
        for g in np.flatnonzero(large).tolist()
    ]
