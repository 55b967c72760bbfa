"""Say doubts in plain sentences with numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Floats, Ints
from objslam.core.object_map import MapObject
from objslam.core.result import Doubt, RunResult
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.mapping.doubts.groups import REASONS, BoxGroups
from objslam.mapping.doubts.pairs import Pairs
from objslam.mapping.doubts.splits import Splits

_CLOSE = np.log(20.0)  # Log odds below this are called close. A larger value calls more odds close.
_SURE = 1000
"""The largest odds that are said as a number. Larger odds are said to be more than this, because the model of the boxes is
not exact enough. With a larger number, more odds are said exactly."""
_DISAGREE = 2.0
"""Rays disagree with an object if their root mean square distance from it is at least this multiple of their noise. With a
larger number, fewer objects are said to have rays that disagree."""
_SPAN = (0.1, 0.9)
"""The quantiles of the stamps of an object's boxes between which the object was seen. They leave out single boxes of other
things. A wider span finds fewer pairs whose boxes follow one another in time."""
_MOVED = 1.0
"""The least distance, in sigmas, between the places of a pair that may be one thing that moved. With a larger number, fewer
pairs are said to be things that moved."""
_BESIDE = 0.5
"""The largest distance (m) at which a sentence names the nearest object, if the object has the label of the boxes. An object
of another label is named within half its size. A larger distance names more objects."""


def in_words(result: RunResult, pairs: Pairs, splits: Splits, groups: BoxGroups) -> tuple[Doubt, ...]:
    """Return all doubts in words. Pairs are sorted by probability, and groups by their number of boxes."""
    unresolved = (_unresolved(result, j) for j, o in enumerate(result.map.objects) if o.status != "ok")
    return (*_pairs(result, pairs), *_splits(result, splits), *unresolved, *_groups(result, groups))


def why_unresolved(result: RunResult, j: int) -> str:
    """Return why the object with the index j has no position, with the limit from the settings."""
    o, limits = result.map.objects[j], result.settings.triangulation
    if o.rays < 2:
        return "a single ray gives a direction and no distance"
    if o.parallax_deg < limits.min_parallax_deg:
        least = f"triangulation.min_parallax_deg {limits.min_parallax_deg:g}"
        return f"its {o.rays} rays span {o.parallax_deg:.1f} deg ({least})"
    noise = _noise_deg(result, j)
    if o.rms_deg > _DISAGREE * noise:
        return f"its {o.rays} rays disagree: they miss it by {o.rms_deg:.2g} deg (RMS), but their noise is {noise:.2g} deg"
    most = f"its sigma exceeds {limits.max_rel_sigma:g} of its distance (triangulation.max_rel_sigma)"
    return f"its {o.rays} rays span {o.parallax_deg:.1f} deg, too little for their noise of {noise:.2g} deg: {most}"


def _noise_deg(result: RunResult, j: int) -> float:
    """Return the median standard deviation (deg) of the rays of an object.

    At given poses, it includes the noise of the headings. If the object has a position, it also includes the noise of the
    robot's places.
    """
    mine = np.flatnonzero(result.association.object == j)
    sigma = result.rays.sigma[mine]
    if result.settings.mode == "fixed":
        every, place = pose_noise(result.rays, result.keyframes, result.settings)
        away = np.linalg.norm(result.origins[mine] - result.map.objects[j].position, axis=1)
        sigma = np.hypot(every[mine], np.nan_to_num(place / np.maximum(away, MIN_DEPTH)))
    return float(np.degrees(np.median(sigma)))


def _pairs(result: RunResult, pairs: Pairs) -> Iterator[Doubt]:
    for i, (j, k) in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        a, b = result.map.objects[j], result.map.objects[k]
        # The test compares the points where rays meet. The centres of bodies can be nearer to each other.
        apart, expected = float(np.linalg.norm(a.position - b.position)), float(pairs.expected[i])
        if expected < 1:
            frames = "no frame should show both"
        else:
            frames = f"{_frames(int(pairs.together[i]))} both, and two things would be together in about {expected:.0f}"
        yield Doubt(
            "pair",
            "may be one",
            a.label,
            f"{_name(a)} and {_name(b)} may be one (probability {pairs.probability[i]:.2f}): they are {_length(apart)} "
            f"apart, {pairs.sigmas[i]:.1f} sigma; {frames}.{_if_moved(result, j, k) if pairs.sigmas[i] >= _MOVED else ''}",
            (a.id, b.id),
            (a.position + b.position) / 2,
            np.flatnonzero(np.isin(result.association.object, [j, k])),
            {
                **{"probability": pairs.probability[i], "distance_m": apart, "sigmas": pairs.sigmas[i]},
                **{"frames_with_both": pairs.together[i], "frames_with_both_expected": expected},
            },
        )


def _if_moved(result: RunResult, j: int, k: int) -> str:
    """Return the sentence about a pair whose boxes follow one another in time, "" if they do not."""
    stamps, owner = result.keyframes.stamps[result.rays.keyframe], result.association.object
    if not ((owner == j).any() and (owner == k).any()):  # An object of an older map may have no box today.
        return ""
    (a, first), (b, second) = sorted(
        ((one, np.quantile(stamps[owner == one], _SPAN)) for one in (j, k)), key=lambda of: of[1][0]
    )
    if first[1] >= second[0]:
        return ""
    names = _name(result.map.objects[a]), _name(result.map.objects[b])
    return f" {names[0]} was seen before {names[1]}, so it may have moved from one place to the other."


def _splits(result: RunResult, splits: Splits) -> Iterator[Doubt]:
    for i in np.argsort(-splits.rays.min(axis=1, initial=0), kind="stable").tolist():
        j = int(splits.object[i])
        o, (one, two), (m, n) = result.map.objects[j], splits.centre[i], splits.rays[i].tolist()
        both = f"; {_frames(int(splits.together[i]))} both" if splits.together[i] else ""
        yield Doubt(
            "split",
            "may be two",
            o.label,
            f"{_name(o)} may be two: {m} of its rays meet near {in_place(one)} and {n} near {in_place(two)}, "
            f"{_length(splits.gap[i])} apart across the rays; 3 sigma of a ray are {_length(3 * splits.noise[i])}{both}.",
            (o.id,),
            o.position,
            np.flatnonzero(result.association.object == j),
            {
                **{"rays_first": m, "rays_second": n, "gap_m": splits.gap[i], "sigma_m": splits.noise[i]},
                **{"frames_with_both": splits.together[i]},
            },
        )


def _unresolved(result: RunResult, j: int) -> Doubt:
    o = result.map.objects[j]
    why = "no parallax" if o.parallax_deg < result.settings.triangulation.min_parallax_deg or o.rays < 2 else "unsure"
    return Doubt(
        "unresolved",
        why,
        o.label,
        f"{_name(o)} has no position: {why_unresolved(result, j)}.",
        (o.id,),
        o.position if np.isfinite(o.position).all() else None,
        np.flatnonzero(result.association.object == j),
        {"rays": o.rays, "parallax_deg": o.parallax_deg},
    )


def _groups(result: RunResult, groups: BoxGroups) -> Iterator[Doubt]:
    if not len(groups):
        return
    number = np.bincount(groups.group, minlength=len(groups))
    order = np.argsort(groups.group, kind="stable")
    rays = np.split(groups.ray[order], np.cumsum(number)[:-1])
    for g in np.argsort(-number, kind="stable").tolist():
        reason, label = REASONS[groups.reason[g]], result.rays.label_names[groups.label[g]]
        near = None if groups.object[g] < 0 else result.map.objects[groups.object[g]]
        about = (
            (near.id,) if near is not None and (reason == "on an object" or _is_beside(near, label, groups.away[g])) else ()
        )
        placed = reason not in ("fixed in the image", "on an object", "follow")
        where = f" near {in_place(groups.position[g])}" if placed else ""
        beside = f" It is {_length(groups.away[g])} from {_name(near)}." if placed and about and near is not None else ""
        place = near.position if reason == "on an object" and near is not None else groups.position[g] if placed else None
        yield Doubt(
            "boxes",
            reason,
            label,
            f"{number[g]} {label} boxes{where}{why_no_object(result, groups, g, np.sort(rays[g]))}.{beside}",
            about,
            place,
            np.sort(rays[g]),
            {
                **{"boxes": number[g], "miss_m": groups.miss[g], "sigma_m": groups.sigma[g]},
                **{"parallax_deg": np.degrees(groups.parallax[g]), "frames": groups.seen[g]},
                **{"frames_expected": groups.expected[g], "size_m": groups.size[g], "log_odds": groups.odds[g]},
            },
        )


def _is_beside(o: MapObject, label: str, away: float) -> bool:
    """Return whether an object is so near to boxes of a label that it may explain them. away: m."""
    return away <= (_BESIDE if o.label == label else max(o.extent or (0.0,)) / 2)


def why_no_object(result: RunResult, groups: BoxGroups, g: int, rays: Ints) -> str:
    """Return the end of the sentence about group g: why its boxes are no object. rays: (n,) the rows of the group's boxes in
    the rays of the result."""
    label = result.rays.label_names[groups.label[g]]
    miss, sigmas = _length(groups.miss[g]), _length(3 * groups.sigma[g])
    match REASONS[groups.reason[g]]:
        case "fixed in the image":
            box = np.median(result.rays.box[rays], axis=0)
            camera = result.cameras[result.keyframes.camera[result.rays.keyframe[rays[0]]]].name
            middle = f"({(box[0] + box[2]) / 2:.0f}, {(box[1] + box[3]) / 2:.0f})"
            return (
                f" stay at pixel {middle} of camera {camera} while the camera turns: "
                "a part of the robot, a ghost of the detector, or equal things that the robot passes in the same way"
            )
        case "on an object":
            o = result.map.objects[groups.object[g]]
            if o.label == label:
                return f" lie on {_name(o)}; {groups.double[g]} of them are in frames in which it has another box"
            return f" lie on {_name(o)}: an object of another label is there"
        case "follow":
            stamps = result.keyframes.stamps[result.rays.keyframe[rays]] - result.keyframes.stamps[0]
            time = f"{stamps.min():.1f} to {stamps.max():.1f} s after the start"
            return f", {time}, follow one another, and no thing at rest explains them: it moves, or its boxes wander over it"
        case "few":
            least = result.settings.association.min_rays
            return f": too few rays for an object (association.min_rays {least})"
        case "no parallax":
            return f": their rays span {np.degrees(groups.parallax[g]):.1f} deg, too little to measure a distance"
        case "apart":
            return f": their rays miss a common point by {miss}, and 3 sigma are {sigmas}"
        case "range":
            return f": their ranges are {groups.range[g]:.2f} m, and their rays meet at {groups.distance[g]:.2f} m"
        case "rare":
            share = f"{100 * groups.rate[g]:.0f} %"
            expected = f"{groups.seen[g]} of {groups.expected[g]} frames that should show it do"
            return f": their rays meet, but only {expected}; an object of this label is in about {share}"
        case "size":
            size, usual = _length(groups.size[g]), _length(groups.usual_size[g])
            known = f", and objects of this label {usual}" if groups.usual_size[g] else ", unlike others of this label"
            return f": the thing would be {size} large{known}"
        case "moves":
            way = _length(groups.way[g])
            causes = "it moves, or its boxes wander over it"
            if not result.keyframes.localized_every:  # Drift between two visits looks like a motion of the thing.
                causes = "it moves, its boxes wander over it, or the path drifted between its boxes"
            return f": a point that moves by {way} explains them better than one at rest: {causes}"
        case "chance":
            return ": as many rays of other boxes of this label would meet there by chance"
        case _:
            odds = min(float(np.exp(np.abs(groups.odds[g]))), _SURE)
            number = f"more than {_SURE}" if odds == _SURE else f"{odds:.0f}" if odds >= 10 else f"{odds:.1f}"
            meet = f": their rays meet within {miss}, and the odds are"
            if groups.odds[g] <= 0:
                return f"{meet} {number} to 1 against an object"
            if groups.odds[g] < _CLOSE:
                return f"{meet} {number} to 1 for an object, which is too close to add one"
            return f"{meet} {number} to 1 for an object, but no search kept one there: a thing may be missing"


def _frames(count: int) -> str:
    return "no frame shows" if count == 0 else "1 frame shows" if count == 1 else f"{count} frames show"


def _name(o: MapObject) -> str:
    return f"{o.label} #{o.id}"


def in_place(position: Floats) -> str:
    """Return a position (3,), m, in words."""
    return f"({position[0]:.2f}, {position[1]:.2f}, {position[2]:.2f})"


def _length(metres: float) -> str:
    """Return a length in words: mm, cm or m, with two digits."""
    value = float(metres)
    if value >= 0.995:
        return f"{value:.1f} m" if value < 99.5 else f"{value:.0f} m"
    if value >= 0.00995:
        return f"{100 * value:.0f} cm" if value >= 0.0995 else f"{100 * value:.1f} cm".replace(".0 cm", " cm")
    return f"{1000 * value:.1f} mm".replace(".0 mm", " mm")
