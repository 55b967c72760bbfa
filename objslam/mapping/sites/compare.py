"""Compare two maps of one place: what is still there, what moved, what is gone, and what is new."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from objslam.association.registration.map_registration import Registration
from objslam.association.registration.object_maps import reason, register
from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject
from objslam.mapping.sites.merge import merge_sessions
from objslam.mapping.sites.session import Session

Outcome = Literal["confirmed", "moved", "gone", "new", "unseen"]
"""What became of an object. `unseen`: the later session did not find it, and could not tell that it is gone."""
OUTCOMES: tuple[Outcome, ...] = ("confirmed", "moved", "gone", "new", "unseen")
"""All outcomes, in the order in which they are told."""


@dataclass(frozen=True)
class Change:
    """What became of one object. probability: that it is where `item` says, or for one that is gone, that it is gone."""

    outcome: Outcome
    item: MapObject
    probability: float


@dataclass(frozen=True)
class Comparison:
    """Two maps in the frame of the first.

    changes: one for each object of both maps, empty if the registration was refused. reason: of the verdict, in a few words.
    a_T_b: (4, 4) how the other map lies in the frame of the first.
    """

    registration: Registration
    reason: str
    changes: tuple[Change, ...]
    a_T_b: Floats

    def of(self, outcome: Outcome) -> tuple[Change, ...]:
        """Return the changes of one kind."""
        return tuple(one for one in self.changes if one.outcome == outcome)


def compare(a: Session, b: Session) -> Comparison:
    """Compare a map with that of a later session. The later one needs its views to say that an object is gone."""
    found = register(b.objects, a.objects)
    why = reason(found, b.objects, a.objects, (b.name, a.name))
    if not found.accepted:
        return Comparison(found, why, (), found.b_T_a)
    island = merge_sessions((a, b))[0]
    changes = []
    for item in (*island.objects, *island.objects.gone):
        assert item.life is not None
        changes.append(_change(item, island.seen_by[item.id]))
    changes.sort(key=lambda one: (OUTCOMES.index(one.outcome), one.item.label, one.item.id))
    return Comparison(found, why, tuple(changes), island.site_T_session[island.sessions.index(1)])


def _change(item: MapObject, seen_by: tuple[int, ...]) -> Change:
    assert item.life is not None
    p = item.life.probability
    if item.life.state == "gone":
        return Change("gone", item, 1 - p)
    if item.life.state == "moved":
        return Change("moved", item, p)
    if 1 not in seen_by:
        return Change("unseen", item, p)
    return Change("confirmed" if 0 in seen_by else "new", item, p)
