"""Labels that were seen, but have no object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import widest_angle
from objslam.core.result import Doubt, RunResult
from objslam.mapping.doubts.cut_things import CutThing
from objslam.mapping.doubts.evidence import Evidence
from objslam.mapping.doubts.groups import REASONS, described_group
from objslam.mapping.doubts.words import in_place, why_no_object

_FEWEST = 3
"""The fewest frames that show a label without an object that is named. With a larger number, fewer labels of false boxes are
named, but also fewer things that were seen only for a moment."""
_NAMED = 3
"""The most labels that the assessment names. A larger number makes the assessment longer if a detector knows many labels."""


def unmapped_labels(result: RunResult, evidence: Evidence, things: Sequence[CutThing]) -> list[Doubt]:
    """Return a doubt for each label that was seen in `_FEWEST` frames, if none of its boxes belongs to an object.

    Boxes that the image's edge cuts off count as seen. The label in the most frames comes first. evidence: the evidence of
    the result. things: the things that have only cut off boxes. A doubt names their places.
    """
    rays, found = result.rays, result.association.object
    labels = len(rays.label_names)
    of_ray = result.keyframes.camera[rays.keyframe], result.keyframes.frame[rays.keyframe]
    label, image = rays.label, np.stack(of_ray, axis=1)
    cut = np.zeros(labels, dtype=np.int64)
    if rays.cut is not None:
        cut = np.bincount(rays.cut.label, minlength=labels)
        label = np.append(label, rays.cut.label)
        image = np.vstack([image, np.stack([rays.cut.camera, rays.cut.frame], axis=1)])
    frames = np.bincount(np.unique(np.column_stack([label, image]), axis=0)[:, 0], minlength=labels)
    mapped = np.bincount(rays.label[found >= 0], minlength=labels) > 0
    lost = np.flatnonzero((frames >= _FEWEST) & ~mapped)
    return [
        _doubt(result, evidence, i, int(frames[i]), int(cut[i]), things)
        for i in lost[np.argsort(-frames[lost], kind="stable")].tolist()
    ]


def in_assessment(doubts: list[Doubt]) -> list[str]:
    """Return the sentences about the labels for the assessment."""
    named, more = [one.text for one in doubts[:_NAMED]], len(doubts) - _NAMED
    if more > 0:
        named.append(f"{more} more label{'' if more == 1 else 's'} without an object: `objslam explain` names them.")
    return named


def _doubt(result: RunResult, evidence: Evidence, label: int, frames: int, cut: int, things: Sequence[CutThing]) -> Doubt:
    mine = np.flatnonzero(result.rays.label == label)
    name, parallax = result.rays.label_names[label], np.degrees(widest_angle(result.directions[mine])) if len(mine) else 0.0
    reason, why, place = _why(result, evidence, mine, float(parallax), cut)
    if not len(mine) and (places := [thing for thing in things if thing.label == label]):
        place = places[0].position
        why += f", roughly near {' and '.join(thing.place() for thing in places)}"
    return Doubt(
        "label",
        reason,
        name,
        f"No object has the label {name!r}, which {frames} frames show. {why[0].upper()}{why[1:]}.",
        (),
        place,
        mine,
        {"frames": frames, "boxes": len(mine), "boxes_cut_off": cut, "parallax_deg": float(parallax)},
    )


def _why(result: RunResult, evidence: Evidence, mine: Ints, parallax: float, cut: int) -> tuple[str, str, Floats | None]:
    """Return why the boxes `mine` (B,) of a label are no object. The three values are the reason in short, the reason as a
    sentence, and the place (3,) of the boxes. The place is None if the boxes have none. parallax: deg.
    """
    settings, edge = result.settings, "the image's edge cuts off"
    least = settings.association.min_rays
    if not len(mine):
        return "cut off", f"{edge} all of its {cut} boxes (rays.border, rays.border_share)", None
    if len(mine) < least:
        also = f", and {edge} {cut} more" if cut else ""
        return "few", f"only {len(mine)} of its boxes can be used (association.min_rays {least}){also}", None
    if parallax < settings.triangulation.min_parallax_deg:
        return "no parallax", f"its {len(mine)} rays span {parallax:.1f} deg, too little to measure a distance", None
    group = described_group(evidence, mine, settings)
    reason, place = REASONS[group.reason[0]], group.position[0]
    also = f". {edge.capitalize()} {cut} more boxes" if cut else ""
    where = "" if reason == "apart" else f" near {in_place(place)}"
    told = f"its {len(mine)} boxes{where}{why_no_object(result, group, 0, mine)}{also}"
    return reason, told, None if reason == "apart" else place
