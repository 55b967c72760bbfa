"""Update the life of each object of a site, session after session. A `Life` says what became of an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from objslam.association.persistence import persistence
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.object_map import Fate, Life, MapObject
from objslam.mapping.sites.session import Session

GONE = 0.5
"""The probability of existence below which an object counts as gone. With a larger value, objects count as gone sooner."""
FORGOTTEN = 0.01
"""The probability of existence below which a site forgets an object that is gone. With a larger value, it forgets sooner."""
UNPROVEN = 0.9
"""The largest probability of existence of an object that one session found. If the session gives no probability, this value
is used. A larger value trusts single sessions more."""
_DAY = 86_400.0  # The seconds of a day.
_ALIKE = 2.0
"""The largest ratio of the sizes of an object before and after it moved. With a larger value, more pairs count as one
object."""


@dataclass
class Track:
    """One object over the sessions of a site.

    item: the object as seen last. number: the object's id in the site, None for a new object. life: the life after the
    sessions so far, None before the first session. places: the object's measurements, as rows of the joint solve. begun,
    met: the first and the last session that found the object, as indices in the order of time. since: the time (s) when the
    object was first seen. was: the track of the same object at its earlier place, None if it did not move.
    """

    item: MapObject
    number: int | None = None
    life: Life | None = None
    places: list[int] = field(default_factory=list)
    begun: int = 0
    met: int = 0
    since: float = np.nan
    was: Track | None = None


def after_session(tracks: list[Track], found: Bools, looks: Ints, seen: list[MapObject | None], when: float) -> list[Life]:
    """Return the life of each of N tracks after one session.

    found: (N,) whether the session found each object. looks: (N,) in how many frames of the session each should have been
    detected. seen: each object as the session has it, None if the session did not find it. when: the time of the session, s.
    A track without a life gets its first one.
    """
    old = [t.life for t in tracks]
    before = np.array([UNPROVEN if life is None else life.probability for life in old])
    days = np.array([0.0 if life is None else max(when - life.updated, 0.0) / _DAY for life in old])
    past = np.array([(0, 0) if life is None else (life.looks, life.detections) for life in old]).reshape(-1, 2)
    probability = persistence(before, days, found, looks, past[:, 0], past[:, 1])
    lives = []
    for k, life in enumerate(old):
        item = seen[k]
        detections = 0 if item is None else item.frames
        views = max(int(looks[k]), detections)
        if life is None:
            assert item is not None
            exists = UNPROVEN if item.existence is None else min(item.existence, UNPROVEN)
            lives.append(Life("unconfirmed", exists, 1, 1, views, detections, when))
            continue
        p = float(probability[k])
        met = bool(found[k])
        lives.append(
            replace(
                life,
                state=_fate(life, p, met),
                probability=p,
                sessions_expected=life.sessions_expected + int(met or looks[k] > 0),
                sessions_seen=life.sessions_seen + int(met),
                looks=life.looks + views,
                detections=life.detections + detections,
                updated=when,
            )
        )
    return lives


def there_before(
    session: Session, items: Sequence[MapObject], positions: Floats, session_T_site: Floats, before: Floats
) -> Floats:
    """Return the probability (N,) that each object was already there in an earlier session that did not find it.

    The probability is 0 if the session does not say what was in view. With a probability below `GONE`, the object counts as
    new. positions: (N, 3) m, in the frame of the site. session_T_site: (4, 4). before: (N,) the same probability after the
    sessions treated so far, `UNPROVEN` at first.
    """
    visits = session.visits() if session.views is None else ()
    parts = [(one.session, one.session_T_site @ session_T_site) for one in visits] or [(session, session_T_site)]
    if any(part.views is None for part, _ in parts):
        return np.zeros(len(items))
    past = np.array([(0, 0) if o.life is None else (o.life.looks, o.life.detections) for o in items]).reshape(-1, 2)
    none = np.zeros(len(items))
    for part, part_T_site in parts:
        looks = part.looks(tuple(items), positions, part_T_site)
        before = persistence(before, none, none.astype(bool), looks, past[:, 0], past[:, 1])
    return before


def joined(old: Life, new: Life) -> Life:
    """Return the life of an object that two sites have. old, new: its life in the earlier and in the later site.

    The odds of the later site, divided by the odds of its prior `UNPROVEN`, are the evidence of its sessions alone. The
    earlier site gets one more session that found the object. Then its odds are multiplied by this evidence.
    """
    days = np.array([max(new.updated - old.updated, 0.0) / _DAY])
    one, none = np.ones(1, dtype=bool), np.zeros(1, dtype=np.int64)
    met = float(persistence(np.array([old.probability]), days, one, none, none, none)[0])
    odds = _odds(new.probability) * _odds(met) / _odds(UNPROVEN)
    probability = odds / (1 + odds)
    state: Fate = "gone" if probability < GONE else "moved" if new.state == "moved" else "confirmed"
    return Life(
        state,
        probability,
        old.sessions_expected + new.sessions_expected,
        old.sessions_seen + new.sessions_seen,
        old.looks + new.looks,
        old.detections + new.detections,
        new.updated,
        old.moved_from if new.moved_from is None else new.moved_from,
    )


def _odds(probability: float) -> float:
    p = min(max(probability, 1e-9), 1 - 1e-9)  # As limited by `persistence`.
    return p / (1 - p)


def _fate(life: Life, probability: float, found: bool) -> Fate:
    if probability < GONE:
        return "gone"
    if found:
        return "confirmed"
    return "confirmed" if life.state == "gone" else life.state


def may_be_one(a: MapObject, b: MapObject) -> bool:
    """Return whether an object that is gone and a new object may be one object that moved: same label, similar size."""
    if a.label != b.label:
        return False
    if a.extent is None or b.extent is None:
        return True
    ratio = np.array(a.extent).prod() / max(np.array(b.extent).prod(), 1e-9)
    return bool(_ALIKE**-2 <= ratio <= _ALIKE**2)
