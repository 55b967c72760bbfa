"""Find which sessions share objects, the transforms between these sessions, and which objects are the same.

A session is registered to the map of all sessions placed so far, not to each single session. So a session takes one
registration, also among many sessions. The map also gives more evidence than a single session. It has more objects, and each
object has the label that most sessions gave it. The transforms are only a start, because a joint solve of all sessions
follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.registration.joint_frames import solve_frames
from objslam.association.registration.object_maps import placed, register
from objslam.core.arrays import Floats
from objslam.core.maps.shared_covariance import shared_covariance
from objslam.core.object_map import MapObject, ObjectMap
from objslam.mapping.sites.covariances import measured_objects
from objslam.mapping.sites.matching import same_objects
from objslam.mapping.sites.session import Session

Seen = tuple[int, MapObject]
"""The index of a session, and an object as this session has it."""


@dataclass(frozen=True)
class Part:
    """One map of sessions that share objects.

    objects: the map, in the frame of one of the sessions. It has the objects of `tracks`, in the same order: first all
    objects that are present in a session, then the gone objects. tracks: each object as each of its sessions has it.
    site_T_session: (4, 4) for each session, takes points from the session to the frame of the map. log_odds: the log odds of
    the registration that joined each session to the others. It is NaN for the session that gives the frame.
    """

    objects: ObjectMap
    tracks: tuple[tuple[Seen, ...], ...]
    site_T_session: dict[int, Floats]
    log_odds: dict[int, float]


def place_sessions(sessions: Sequence[Session]) -> list[Part]:
    """Return the groups of sessions that share objects. The maps of two groups cannot be registered to each other.

    The sessions with the most objects are placed first. So the result does not depend on the order in which sessions are
    given.
    """
    order = sorted(
        range(len(sessions)), key=lambda s: (-len(placed(sessions[s].objects)), sessions[s].when, sessions[s].name)
    )
    parts: list[Part] = []
    for s in order:
        new, k = _alone(s, sessions[s].objects), 0
        while k < len(parts):
            found = register(new.objects, parts[k].objects)
            if found.accepted:
                new, k = _joined(parts.pop(k), new, found.b_T_a, found.log_odds), 0  # It grew, so other parts may match now.
            else:
                k += 1
        parts = sorted([*parts, new], key=lambda one: -len(one.site_T_session))
    return parts


def _alone(number: int, objects: ObjectMap) -> Part:
    """Return a session as a part. Gone objects may come back, so they are kept and can be matched. A registration does not
    use them."""
    kept = [
        tuple(o for o in some if o.status == "ok" and o.covariance is not None) for some in (objects.objects, objects.gone)
    ]
    tracks = tuple(((number, o),) for some in kept for o in some)
    return Part(replace(objects, objects=kept[0], gone=kept[1]), tracks, {number: np.eye(4)}, {number: np.nan})


def _joined(a: Part, b: Part, a_T_b: Floats, log_odds: float) -> Part:
    """Return two parts as one, in the frame of `a`. a_T_b: (4, 4) takes points from the frame of `b` to that of `a`, from a
    registration."""
    ours, theirs = ([*one.objects.objects, *one.objects.gone] for one in (a, b))
    match = dict(_pairs(ours, theirs, a_T_b))
    track, count = [], len(ours)
    for k in range(len(theirs)):
        track.append(match.get(k, count))
        count += k not in match
    rows = [*((0, k, o) for k, o in enumerate(ours)), *((1, at, o) for at, o in zip(track, theirs, strict=True))]
    shared = [one.objects.shared_covariance for one in (a, b)]
    solved = solve_frames(measured_objects(rows, shared), np.array([np.eye(4), a_T_b]), count, judged=False)
    seen: list[tuple[Seen, ...]] = [*a.tracks, *(() for _ in range(count - len(ours)))]
    present = np.arange(count) < len(a.objects.objects)
    for k, at in enumerate(track):
        seen[at] = (*seen[at], *b.tracks[k])
        present[at] |= k < len(b.objects.objects)
    items = [*ours, *(o for k, o in enumerate(theirs) if k not in match)]
    for k, at in match.items():
        often = [sum(sessions_behind(o) for _, o in seen) for seen in (a.tracks[at], b.tracks[k])]
        items[at] = _with_labels_of(items[at], theirs[k], often)
    items = [
        replace(o, position=position, covariance=covariance, life=None)
        for o, position, covariance in zip(items, solved.positions, solved.covariance, strict=True)
    ]
    order = np.argsort(~present, kind="stable").tolist()
    there = int(present.sum())
    objects = ObjectMap(
        tuple(items[at] for at in order[:there]),
        gone=tuple(items[at] for at in order[there:]),
        shared_covariance=shared_covariance(solved.positions, solved.covariance, solved.correlated),
    )
    frames = {s: solved.site_T_map[1] @ pose for s, pose in b.site_T_session.items()}
    odds = {s: log_odds if np.isnan(value) else value for s, value in b.log_odds.items()}
    return Part(objects, tuple(seen[at] for at in order), {**a.site_T_session, **frames}, {**a.log_odds, **odds})


def _pairs(ours: list[MapObject], theirs: list[MapObject], a_T_b: Floats) -> list[tuple[int, int]]:
    """Return pairs of indices into `theirs` and `ours` that are one object. a_T_b: (4, 4) takes points from the frame of
    `theirs` to that of `ours`."""
    a, b = (ObjectMap(tuple(some)) for some in (ours, theirs))
    turn = a_T_b[:3, :3]
    positions, spread = b.positions @ turn.T + a_T_b[:3, 3], turn @ b.covariances @ turn.T
    return [(k, i) for i, k in same_objects(ours, theirs, a.positions, a.covariances, positions, spread).tolist()]


def _with_labels_of(ours: MapObject, theirs: MapObject, often: Sequence[int]) -> MapObject:
    """Return `ours` with the mean label shares of both objects, and the label with the largest share. often: the number of
    sessions that saw each object."""
    shares = mean_labels([ours, theirs], often)
    return ours if shares is None else replace(ours, labels=shares, label=next(iter(shares)))


def sessions_behind(item: MapObject) -> int:
    """Return the number of sessions that saw an object. It is 1 for an object of a drive."""
    return 1 if item.life is None else item.life.sessions_seen


def mean_labels(items: Sequence[MapObject], often: Sequence[int]) -> dict[str, float] | None:
    """Return the mean share of each label over an object's sessions, with the largest first. Return None if a session has no
    shares.

    often: the weight of each session's shares.
    """
    if any(o.labels is None for o in items):
        return None
    total: dict[str, float] = {}
    for o, weight in zip(items, often, strict=True):
        for name, share in (o.labels or {}).items():
            total[name] = total.get(name, 0.0) + share * weight / sum(often)
    return dict(sorted(total.items(), key=lambda entry: -entry[1]))
