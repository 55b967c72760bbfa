"""Compare two maps of one place: what is still there, what moved, what is gone, and what is new."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.registration.map_registration import Registration
from objslam.association.registration.object_maps import reason, register
from objslam.core.arrays import Floats
from objslam.core.object_map import FATES, Fate, MapObject
from objslam.frontend.up import on_its_side
from objslam.mapping.sites.lives import GONE, UNPROVEN, there_before
from objslam.mapping.sites.merge import Island, merge_sessions
from objslam.mapping.sites.session import Session


@dataclass(frozen=True)
class Change:
    """What became of one object between two maps.

    outcome: a state as in `Life`, for these two maps alone. For example, `confirmed` means that both maps have the object at
    one place. item: the object as both maps together know it, in the frame of the first map. Its `id` is not an id of either
    map. id_a, id_b: the object's id in the first and in the second map, None if the map does not have the object.
    probability: the probability that the object is gone if the outcome is `gone`. With any other outcome, the probability
    that the object is at the place of `item`.
    """

    outcome: Fate
    item: MapObject
    probability: float
    id_a: int | None = None
    id_b: int | None = None


@dataclass(frozen=True)
class Comparison:
    """Two maps in the frame of the first.

    registration: the match of the two maps. reason: why the registration was accepted or refused, in a few words. changes:
    one for each object of both maps, empty if the registration was refused. a_T_b: (4, 4) takes points from the second frame
    to the first. has_views: whether the first and the second map say what was in view. If the second map does not, no object
    counts as gone. If the first map does not, each object that only the second map has counts as new.
    """

    registration: Registration
    reason: str
    changes: tuple[Change, ...]
    a_T_b: Floats
    has_views: tuple[bool, bool]

    def of(self, outcome: Fate) -> tuple[Change, ...]:
        """Return the changes with one outcome."""
        return tuple(one for one in self.changes if one.outcome == outcome)


def compare(a: Session, b: Session) -> Comparison:
    """Compare the map of session `a` with the map of a later session `b`. Without views in `b`, no object counts as gone."""
    found = register(b.objects, a.objects)
    why = reason(found, b.objects, a.objects, (b.name, a.name))
    views = (a.views is not None, b.views is not None)
    if not found.accepted:
        why = on_its_side({a.name: a.up, b.name: b.up}) or why
        return Comparison(found, why, (), found.b_T_a, views)
    island = merge_sessions((a, b))[0]
    changes = _changes(a, b, island)
    changes.sort(key=lambda one: (FATES.index(one.outcome), one.item.label, one.item.id))
    return Comparison(found, why, tuple(changes), island.site_T_session[island.sessions.index(1)], views)


def _changes(a: Session, b: Session, island: Island) -> list[Change]:
    """Return the change of each object of both maps. An object that was already gone in a map counts as not in that map."""
    items = (*island.objects, *island.objects.gone)
    positions = np.array([o.position for o in items]).reshape(-1, 3)
    before = there_before(a, items, positions, np.eye(4), np.full(len(items), UNPROVEN))
    gone = [{o.id for o in one.objects.gone} for one in (a, b)]
    changes = []
    for item, p_before in zip(items, before.tolist(), strict=True):
        assert item.life is not None
        p = item.life.probability
        place, earlier = island.found_as[item.id], island.moved_as.get(item.id, {})
        known = place.get(0, earlier.get(0))
        id_a = None if known in gone[0] else known
        id_b = None if place.get(1) in gone[1] else place.get(1)
        outcome: Fate
        if id_a is None and id_b is None:
            continue
        if id_a is None:
            outcome = "new" if known is not None or p_before < GONE else "unconfirmed"
        elif id_b is None:
            outcome = "gone" if p < GONE else "unconfirmed"
        else:
            outcome = "confirmed" if 0 in place else "moved"
        changes.append(Change(outcome, item, 1 - p if outcome == "gone" else p, id_a, id_b))
    return changes
