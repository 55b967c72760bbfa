"""Compare two maps of one place: what is still there, what moved, what is gone, and what is new."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from objslam.association.persistence import persistence
from objslam.association.registration.map_registration import Registration
from objslam.association.registration.object_maps import reason, register
from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject
from objslam.frontend.up import on_its_side
from objslam.mapping.sites.lives import GONE, UNPROVEN
from objslam.mapping.sites.merge import merge_sessions
from objslam.mapping.sites.session import Session

Outcome = Literal["confirmed", "moved", "gone", "new", "unseen"]
"""What became of an object. `unseen`: only one session found it, and the other did not look at its place often enough."""
OUTCOMES: tuple[Outcome, ...] = ("confirmed", "moved", "gone", "new", "unseen")
"""All outcomes, in the order in which they are shown."""


@dataclass(frozen=True)
class Change:
    """What became of one object.

    probability: of the outcome. If the outcome is `gone`, the object is gone with this probability. With any other outcome,
    it is where `item` is with this probability.
    """

    outcome: Outcome
    item: MapObject
    probability: float


@dataclass(frozen=True)
class Comparison:
    """Two maps in the frame of the first.

    registration: the match of the two maps. reason: why it was accepted or refused, in a few words. changes: one for each
    object of both maps, empty if the registration was refused. a_T_b: (4, 4) takes points from the second frame to the
    first.
    """

    registration: Registration
    reason: str
    changes: tuple[Change, ...]
    a_T_b: Floats

    def of(self, outcome: Outcome) -> tuple[Change, ...]:
        """Return the changes with one outcome."""
        return tuple(one for one in self.changes if one.outcome == outcome)


def compare(a: Session, b: Session) -> Comparison:
    """Compare the map of session `a` with the map of a later session `b`. Without views in `b`, no object counts as gone."""
    found = register(b.objects, a.objects)
    why = reason(found, b.objects, a.objects, (b.name, a.name))
    if not found.accepted:
        why = on_its_side({a.name: a.up, b.name: b.up}) or why
        return Comparison(found, why, (), found.b_T_a)
    island = merge_sessions((a, b))[0]
    items = (*island.objects, *island.objects.gone)
    before = _there_before(a, items)
    changes = [
        _change(item, island.seen_by[item.id], new=a.views is None or p < GONE)
        for item, p in zip(items, before.tolist(), strict=True)
    ]
    changes.sort(key=lambda one: (OUTCOMES.index(one.outcome), one.item.label, one.item.id))
    return Comparison(found, why, tuple(changes), island.site_T_session[island.sessions.index(1)])


def _there_before(a: Session, items: tuple[MapObject, ...]) -> Floats:
    """Return the probability (N,) that each object was there in session `a`, which looked at its place and did not find
    it."""
    looks = a.looks(items, np.array([o.position for o in items]).reshape(-1, 3), np.eye(4))
    lives = np.array([(0, 0) if o.life is None else (o.life.looks, o.life.detections) for o in items]).reshape(-1, 2)
    nobody = np.zeros(len(items), dtype=bool)
    return persistence(np.full(len(items), UNPROVEN), np.zeros(len(items)), nobody, looks, lives[:, 0], lives[:, 1])


def _change(item: MapObject, seen_by: tuple[int, ...], *, new: bool) -> Change:
    """Return the change of one object. seen_by: the sessions that found it, 0 for the earlier and 1 for the later one. new:
    whether an object that only the later session found counts as new. If not, it is `unseen`."""
    assert item.life is not None
    p = item.life.probability
    if item.life.state == "gone":
        return Change("gone", item, 1 - p)
    if item.life.state == "moved":
        return Change("moved", item, p)
    if 1 in seen_by and 0 in seen_by:
        return Change("confirmed", item, p)
    return Change("new" if 1 in seen_by and new else "unseen", item, p)
