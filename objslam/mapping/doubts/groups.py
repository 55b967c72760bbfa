"""Group the boxes that became no object by place, and find the reason why each group is no object."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from objslam.association.existence import chance_odds, rate_odds, rates_of_classes, rest_odds, size_odds
from objslam.association.landmarks import State
from objslam.association.refinement import velocity_gain
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import widest_angle
from objslam.core.statistics import grouped_median
from objslam.mapping.doubts.beside import on_objects
from objslam.mapping.doubts.crossings import crossings
from objslam.mapping.doubts.evidence import Evidence
from objslam.mapping.doubts.in_image import fixed_in_image
from objslam.mapping.doubts.moving import moving_things
from objslam.mapping.doubts.points import MISSED, Points, as_landmarks, fit_points
from objslam.mapping.moves.constant_velocity import Sights
from objslam.mapping.moves.receding_things import moving_along

Reason = Literal[
    "fixed in the image",  # The boxes stay at one place of the image.
    "on an object",  # The boxes lie on an object of the map.
    "follow",  # The boxes follow one another, and no place explains them.
    "few",  # Too few rays pass the place.
    "no parallax",
    "apart",  # The rays do not meet.
    "range",  # The ranges disagree.
    "rare",  # Too few frames show the thing.
    "size",  # The thing has a wrong size.
    "moves",  # The thing moves a little.
    "chance",  # As many strays (boxes of no object) would meet by chance.
    "unclear",  # No single reason.
]
REASONS: tuple[Reason, ...] = get_args(Reason)
"""The reasons why boxes became no object, in the order in which they are tried. All but the first three belong to a
place."""
_OPEN = REASONS.index("unclear")  # The reason of a group before it is examined.
_RANGE_SIGMAS = 3.0
"""The median deviation of ranges from the place above which the ranges disagree, in standard deviations. With a larger
number, fewer groups have this reason."""
_FITTED = 6
"""The number of parameters of a moving point: its place and its velocity. Such a point always explains this number of
measured coordinates. Each ray has two coordinates. With a larger number, fewer groups of few rays are said to move."""
_MOVES = np.log(20.0)
"""The least log odds of motion against rest for a group that is said to move. Boxes of a thing at rest, seen under little
parallax, reach 2.5 if they share an error. With larger odds, fewer groups are said to move."""


@dataclass(frozen=True)
class BoxGroups:
    """G groups of boxes that became no object, and the Q boxes in them.

    ray, group: (Q,) the row of each box in the rays of the result, and its group. label: (G,) index into the label names.
    reason: (G,) index into `REASONS`. position: (G, 3) m, where their rays meet best. miss, sigma: (G,) m, the median
    distance between rays and place, and the median standard deviation of this distance along one axis. parallax: (G,) rad,
    the widest angle between two of the rays. seen, expected: (G,) the number of frames that show the thing, and the number
    that should show it. rate: (G,) the usual share of the frames that show an object of the label, among those that should
    show it. size, usual_size: (G,) m, the size of the thing, and the median size of the objects of its label, 0 if unknown.
    way: (G,) m, the way of the moving point that explains the rays best. range, distance: (G,) m, the median measured range,
    NaN without one, and the median distance to the place. odds: (G,) the log odds that association gives to an object there.
    object: (G,) the index of the nearest object in the map, -1 for none. away: (G,) m, the distance of this object from the
    place. double: (G,) the number of the group's boxes in frames in which this object has a box of its own.
    """

    ray: Ints
    group: Ints
    label: Ints
    reason: Ints
    position: Floats
    miss: Floats
    sigma: Floats
    parallax: Floats
    seen: Ints
    expected: Ints
    rate: Floats
    size: Floats
    usual_size: Floats
    way: Floats
    range: Floats
    distance: Floats
    odds: Floats
    object: Ints
    away: Floats
    double: Ints

    def __len__(self) -> int:
        return len(self.label)


def find_groups(evidence: Evidence, settings: Settings) -> BoxGroups:
    """Return the groups of boxes without an object, each with the reason why it is no object.

    The reasons are tried in the order of `REASONS`, and a box belongs to the first group that takes it. The association
    rejects an object at a place for the same reasons, in the same order.
    """
    left = np.flatnonzero(evidence.left)
    # A rejected ray shows another thing than its object, so it is no box of this object.
    free = replace(evidence.state, matched=np.where(evidence.left, -1, evidence.state.matched))
    evidence = replace(evidence, state=free)
    groups: list[Ints] = []
    kinds: list[int] = []
    owners: list[int] = []

    def take(found: Iterable[tuple[int, Ints]], reason: Reason) -> None:
        nonlocal left
        for owner, rays in found:
            groups.append(rays)
            owners.append(owner)
            kinds.append(REASONS.index(reason))
        left = left[~np.isin(left, np.concatenate([*groups, left[:0]]))]

    take(((-1, rays) for rays in fixed_in_image(evidence, left)), "fixed in the image")
    take(on_objects(evidence, left), "on an object")
    take(((-1, rays) for rays in moving_things(evidence, left)), "follow")
    take(((-1, rays) for rays in crossings(evidence, left)), "unclear")
    return _described(evidence, groups, np.array(kinds, dtype=np.int64), np.array(owners, dtype=np.int64), settings)


def described_group(evidence: Evidence, rays: Ints, settings: Settings) -> BoxGroups:
    """Return rays (n,) of one label as a group, with the reason why it is no object. None of the rays may belong to an
    object."""
    free = replace(evidence.state, matched=np.where(evidence.left, -1, evidence.state.matched))
    mine = np.flatnonzero(np.isin(evidence.ray, rays))
    return _described(replace(evidence, state=free), [mine], np.array([_OPEN]), np.array([-1]), settings)


def _described(evidence: Evidence, groups: list[Ints], reason: Ints, owner: Ints, settings: Settings) -> BoxGroups:
    """Return groups of rays with all their numbers. reason: (G,) index into `REASONS`, `_OPEN` if the reason is not known.
    owner: (G,) the landmark on which the boxes lie, or -1."""
    if not groups:
        arrays: dict[str, Any] = {one.name: np.zeros((0, 3) if one.name == "position" else 0) for one in fields(BoxGroups)}
        return BoxGroups(**arrays)
    points, known, count = fit_points(evidence, groups), evidence.state.count, len(groups)
    state = as_landmarks(evidence, points)
    obs, label = state.obs, state.label[known:]
    by_rate = rate_odds(state, evidence.gate)
    odds: dict[Reason, Floats] = {
        "rare": by_rate[known:],
        "size": size_odds(state)[known:],
        "moves": rest_odds(state)[known:],
    }
    thing, chance = np.sum(list(odds.values()), axis=0), chance_odds(state, evidence.gate)[known:]
    rest = rest_odds(state, _FITTED)[known:]
    sure = {**odds, "moves": np.where(rest < -_MOVES, rest, 0.0)}
    worst = np.argmin(list(sure.values()), axis=0)
    parallax = np.array([widest_angle(obs.direction[rays]) for rays in groups])
    distance = np.linalg.norm(points.position[points.group] - obs.origin[points.ray], axis=1)
    measured = obs.range[points.ray]
    ranged = np.isfinite(measured)
    off = np.abs(measured - distance)[ranged] / obs.range_sigma[points.ray][ranged]
    along, way = moving_along(_sights(state), obs.position_sigma)
    cases: list[tuple[Bools, Reason]] = [
        (reason != _OPEN, "unclear"),  # The reason of these groups is known, and stays.
        (np.bincount(points.group, minlength=count) < settings.association.min_rays, "few"),
        (along[known:], "moves"),
        (points.deviation > MISSED, "apart"),
        (np.degrees(parallax) < settings.triangulation.min_parallax_deg, "no parallax"),
        (np.nan_to_num(grouped_median(off, points.group[ranged], count)) > _RANGE_SIGMAS, "range"),
        *(((thing < 0) & (worst == i), name) for i, name in enumerate(odds)),
        (chance < 0, "chance"),
    ]
    found = np.select([case for case, _ in cases], [REASONS.index(name) for _, name in cases], _OPEN)
    nearest, away, double = _nearest(evidence, points, owner)
    usual = grouped_median(evidence.state.size, evidence.state.label, len(state.unassigned))
    stamps = state.view.stamps[obs.frame[points.ray]]
    factor = state.landmarks.noise[known:]
    return BoxGroups(
        ray=evidence.ray[points.ray],
        group=points.group,
        label=label,
        reason=np.where(reason != _OPEN, reason, found),
        position=points.position,
        miss=points.miss,
        sigma=points.noise,
        parallax=parallax,
        seen=state.history.seen[known:],
        expected=state.history.expected[known:],
        rate=rates_of_classes(state).mean[label],
        size=state.size[known:],
        usual_size=np.nan_to_num(usual)[label],
        way=np.where(
            along[known:], way[known:], velocity_gain(obs, points.ray, points.group, points.position, factor, stamps)[1]
        ),
        range=grouped_median(measured[ranged], points.group[ranged], count),
        distance=grouped_median(distance, points.group, count),
        odds=thing + np.minimum(chance, 0.0),
        object=nearest,
        away=away,
        double=double,
    )


def _sights(state: State) -> Sights:
    """Return the rays and ranges of the landmarks of a state. The noise of the ranges is right up to a factor for each
    label."""
    obs, rays = state.obs, state.assigned
    known = np.isfinite(obs.range[rays])
    return Sights(
        thing=state.owner,
        time=state.view.stamps[obs.frame[rays]],
        origin=obs.origin[rays],
        direction=obs.direction[rays],
        across=np.hypot(obs.sigma[rays] * state.distance, obs.position_sigma),
        range=obs.range[rays],
        nominal=np.where(known, obs.range_sigma[rays], 1.0),
        bias=np.zeros(len(rays)),
        half=obs.size[rays, 0] / 2,
        place=state.landmarks.position,
        label=state.label,
    )


def _nearest(evidence: Evidence, points: Points, owner: Ints) -> tuple[Ints, Floats, Ints]:
    """Return the object of the map that is nearest to each group of boxes, and two numbers about it.

    The three arrays are the object (G,) or -1, its distance (G,) m, and the number (G,) of the group's boxes that are in
    frames in which the object has a box of its own. owner: (G,) the landmark on which the boxes lie. -1 asks for the nearest
    object to the place of the group.
    """
    state, count = evidence.state, len(owner)
    if not state.count:
        return owner, np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    to = points.position[:, None] - state.landmarks.position
    landmark = np.where(owner >= 0, owner, np.linalg.norm(to, axis=2).argmin(axis=1))
    away = np.linalg.norm(points.position - state.landmarks.position[landmark], axis=1)
    frames = len(state.view.camera)
    own = state.owner * frames + state.obs.frame[state.assigned]
    double = np.isin(landmark[points.group] * frames + state.obs.frame[points.ray], own)
    return evidence.object[landmark], away, np.bincount(points.group[double], minlength=count)
