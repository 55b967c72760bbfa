"""Join many sessions to one map of the site. Each session has a frame of its own.

An island is a group of sessions that share objects. A track is one object over the sessions of an island. The life of an
object says what became of it (`Life`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.registration.joint_frames import JointFrames, solve_frames
from objslam.core.arrays import Floats
from objslam.core.bodies.body import Body, surer_body, turned
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.geometry import inverse
from objslam.core.maps.shared_covariance import shared_covariance
from objslam.core.object_map import MapObject, ObjectMap, SeenFrom
from objslam.mapping.seen_sides import thinned
from objslam.mapping.sites.covariances import Row, measured_objects, site_covariances
from objslam.mapping.sites.lives import (
    FORGOTTEN,
    GONE,
    UNPROVEN,
    Track,
    after_session,
    joined,
    may_be_one,
    there_before,
)
from objslam.mapping.sites.placement import Part, mean_labels, place_sessions, sessions_behind
from objslam.mapping.sites.session import Session

_YOUNG = 2
"""The largest number of sessions that saw an object which may have moved to its place. With a larger number, more moves are
found, and more added objects count as moved."""


@dataclass(frozen=True)
class Island:
    """S sessions that share objects, as one map in the frame of the first session.

    objects: the map, with the life of each object. sessions: the indices of the sessions, in the order of time.
    site_T_session: (S, 4, 4). covariance: (S, 4, 4) the covariance of x, y, z (m) and yaw (rad) of each session's frame, 0
    for the first. log_odds: (S,) the log odds of the registration that joined each session to the others, NaN for the first.
    common: for each session, the number of its objects that another session found too. found_as: for each object id, the
    object's id in each session that found it. moved_as: the same for the earlier place of an object that moved between these
    sessions.
    """

    objects: ObjectMap
    sessions: tuple[int, ...]
    site_T_session: Floats
    covariance: Floats
    log_odds: Floats
    common: tuple[int, ...]
    found_as: dict[int, dict[int, int]]
    moved_as: dict[int, dict[int, int]]


def merge_sessions(sessions: Sequence[Session]) -> tuple[Island, ...]:
    """Join each group of sessions that share objects to one island. The largest island comes first.

    sessions: in the order of time. The first session of an island gives its frame. A session that fits no other session is
    an island of its own. If a session is a whole site, its objects keep their lives. The sessions of this site (`visits`)
    are read only for the objects that the site lacks.
    """
    islands = [_island(sessions, part) for part in place_sessions(sessions)]
    return tuple(sorted(islands, key=lambda one: (-len(one.sessions), one.sessions)))


def _island(sessions: Sequence[Session], part: Part) -> Island:
    """Return the sessions of a part as one map: their joint solve, and the life of each object."""
    order = sorted(part.site_T_session)
    turn = {s: number for number, s in enumerate(order)}
    # A row is one measurement: session, track and object. The tracks are in the order in which the sessions found them.
    begun = sorted(part.tracks, key=lambda seen: min((turn[s], o.id) for s, o in seen))
    rows: list[Row] = sorted(
        ((turn[s], at, o) for at, seen in enumerate(begun) for s, o in seen), key=lambda row: (row[0], row[1])
    )
    shared = [sessions[s].objects.shared_covariance for s in order]
    back = inverse(part.site_T_session[order[0]])
    start = np.array([back @ part.site_T_session[s] for s in order])
    solved = solve_frames(measured_objects(rows, shared), start, len(begun))
    tracks = [Track(seen[0][1]) for seen in begun]
    for row, (_, at, _) in enumerate(rows):
        tracks[at].places.append(row)
    alive = _live(sessions, order, tracks, rows, solved)
    _name_new(sessions, order, [tracks[at] for at in alive], solved.positions[alive], solved.site_T_map)
    objects, track_of = _objects(tracks, alive, rows, solved, shared)
    found_as, moved_as = {}, {}
    for number, at in track_of.items():
        found_as[number] = {order[turn]: o.id for turn, _, o in (rows[row] for row in tracks[at].places)}
        if (was := tracks[at].was) is not None:
            moved_as[number] = {order[turn]: o.id for turn, _, o in (rows[row] for row in was.places)}
    often = np.bincount([at for _, at, _ in rows], minlength=len(tracks))
    common = np.bincount([n for n, at, _ in rows if often[at] > 1], minlength=len(order))
    odds = [part.log_odds[s] for s in order]
    odds[int(np.isnan(odds).argmax())], odds[0] = odds[0], np.nan  # The earliest session gives the frame of the island.
    frames, covariance = solved.site_T_map, solved.frame_covariance
    seen = (tuple(common.tolist()), found_as, moved_as)
    return Island(objects, tuple(order), frames, covariance, np.array(odds), *seen)


def _live(
    sessions: Sequence[Session],
    order: list[int],
    tracks: list[Track],
    rows: list[Row],
    solved: JointFrames,
) -> list[int]:
    """Update the lives of the tracks, session after session in the order of time. Return the tracks that `_follow` left."""
    begun: list[int] = []
    found: list[dict[int, MapObject]] = [{} for _ in order]
    for number, at, item in rows:
        found[number][at] = item
    for turn, here in enumerate(found):
        session = sessions[order[turn]]
        fresh = [at for at in here if at not in begun]
        for at in fresh:
            tracks[at].life, tracks[at].begun, tracks[at].since = here[at].life, turn, here[at].first_seen
            if turn == 0 or here[at].life is not None:
                tracks[at].number = here[at].id
        site = any(item.life is not None for item in here.values())
        if site:
            _join_lives(tracks, begun, here)
        for at in fresh:
            tracks[at].item = _in_site(here[at], None, solved.site_T_map[turn])
        back = inverse(solved.site_T_map[turn])
        missed = [at for at in begun if at not in here]
        begun += fresh
        some = begun if not site else [at for at in fresh if tracks[at].life is None]
        _visit(tracks, some, here, session, solved.positions, back)
        if site and missed:
            for visit in session.visits():
                _visit(tracks, missed, {}, visit.session, solved.positions, visit.session_T_site @ back)
        for at, item in here.items():
            tracks[at].item, tracks[at].met = _in_site(item, tracks[at].item, solved.site_T_map[turn]), turn
        begun = _follow(tracks, begun, solved.positions, fresh if site and turn else ())
    return begun


def _name_new(
    sessions: Sequence[Session], order: list[int], tracks: list[Track], positions: Floats, site_T_session: Floats
) -> None:
    """Set the state of an unconfirmed object to `new` if an earlier session would have found the object at its place.

    positions: (N, 3) m, of the tracks, in the frame of the site.
    """
    alone = [k for k, t in enumerate(tracks) if t.begun and t.life is not None and t.life.state == "unconfirmed"]
    probability = np.full(len(tracks), UNPROVEN)
    for turn, s in enumerate(order):
        some = [k for k in alone if tracks[k].begun > turn and probability[k] >= GONE]
        if some:
            items = [replace(tracks[k].item, life=tracks[k].life) for k in some]
            back = inverse(site_T_session[turn])
            probability[some] = there_before(sessions[s], items, positions[some], back, probability[some])
    for k in alone:
        if probability[k] < GONE and (life := tracks[k].life) is not None:
            tracks[k].life = replace(life, state="new")


def _join_lives(tracks: list[Track], begun: list[int], here: dict[int, MapObject]) -> None:
    """Join the lives of the objects that are in `begun` and in a site. here: the objects of the site, by track."""
    for at in begun:
        old, new = tracks[at].life, here[at].life if at in here else None
        if old is not None and new is not None:
            tracks[at].life = joined(old, new)


def _visit(
    tracks: list[Track], some: list[int], here: dict[int, MapObject], session: Session, positions: Floats, back: Floats
) -> None:
    """Update the lives of some tracks with a session. here: the objects that the session found, by track. back: (4, 4)
    session_T_site."""
    looks = session.looks(tuple(tracks[at].item for at in some), positions[some], back)
    found = np.array([at in here for at in some], dtype=bool)
    lives = after_session([tracks[at] for at in some], found, looks, [here.get(at) for at in some], session.when)
    for at, life in zip(some, lives, strict=True):
        tracks[at].life = life


def _in_site(item: MapObject, before: MapObject | None, site_T_session: Floats) -> MapObject:
    """Return an object of a session for the site. Its `seen_from` has the sides from which this session or an earlier one
    saw it.

    before: the object after the earlier sessions, None if they did not see it.
    """
    seen = item.seen_from
    if seen is not None:
        seen = replace(seen, sides=seen.sides @ site_T_session[:3, :3].T)
        if before is not None and (old := before.seen_from) is not None:
            sides = thinned(np.concatenate([old.sides, seen.sides]))
            seen = SeenFrom(min(old.near, seen.near), max(old.far, seen.far), sides)
    return replace(item, life=None, seen_from=seen)


def _follow(tracks: list[Track], begun: list[int], positions: Floats, came: Sequence[int]) -> list[int]:
    """Find objects that moved, and return the tracks without those of their earlier places.

    An object moved if its track is gone, and a similar track is new at another place. The new track takes the number of the
    gone track. begun: the tracks so far. came: the tracks that a later site brought. They count as new, however many
    sessions of that site saw them.
    """
    lives = {at: life for at in begun if (life := tracks[at].life) is not None}
    old = [at for at, life in lives.items() if life.state == "gone"]
    young = [at for at, life in lives.items() if life.state != "gone" and (life.sessions_seen <= _YOUNG or at in came)]
    left = list(begun)
    for at in old:
        may = [k for k in young if _later(tracks[k], tracks[at]) and may_be_one(tracks[at].item, tracks[k].item)]
        if not may:
            continue
        now = min(may, key=lambda k: float(np.linalg.norm(positions[k] - positions[at])))
        state = "moved" if lives[now].sessions_seen <= _YOUNG else lives[now].state
        tracks[now].life, tracks[now].was = replace(lives[now], state=state, moved_from=positions[at]), tracks[at]
        if tracks[at].number is not None:
            tracks[now].number = tracks[at].number
        left.remove(at)
        young.remove(now)
    return left


def _later(young: Track, old: Track) -> bool:
    """Return whether `young` was first seen in a later session than the last one that saw `old`. Within the first session,
    return whether `young` was first seen after `old` was last seen."""
    return young.begun > old.met or (young.begun == old.met == 0 and young.since > old.item.last_seen)


def _objects(
    tracks: list[Track], alive: list[int], rows: list[Row], solved: JointFrames, shared: Sequence[Floats | None]
) -> tuple[ObjectMap, dict[int, int]]:
    """Return the map of the tracks `alive`, and the track of each id.

    Objects with a probability below `FORGOTTEN` are left out. shared: as for `measured_objects`.
    """
    free = max((t.number for t in tracks if t.number is not None), default=-1) + 1
    there, gone = [], []
    used: dict[int, int] = {}
    covariance, correlated = site_covariances(solved, rows, shared)
    for at in alive:
        track = tracks[at]
        number = track.number if track.number is not None and track.number not in used else free
        free = max(free, number + 1)
        used[number] = at
        of = [rows[row] for row in track.places]
        assert track.life is not None
        item = replace(
            track.item,
            id=number,
            position=solved.positions[at],
            covariance=covariance[at],
            labels=mean_labels([o for _, _, o in of], [sessions_behind(o) for _, _, o in of]),
            body=_surest_body(solved, of),
            ray_point=None,
            first_seen=min(o.first_seen for _, _, o in of),
            last_seen=max(o.last_seen for _, _, o in of),
            life=track.life,
            tag=_best_tag(solved, of),
        )
        item = replace(item, label=max(item.labels, key=lambda n: (item.labels or {})[n]) if item.labels else item.label)
        if track.life.probability >= GONE:
            there.append(item)
        elif track.life.probability >= FORGOTTEN:
            gone.append(item)
    kept = list(used.values())
    together = shared_covariance(solved.positions[kept], covariance[kept], correlated[kept])
    return ObjectMap(tuple(there), "site", tuple(gone), together), used


def _surest_body(solved: JointFrames, of: list[Row]) -> Body | None:
    """Return the body whose size has the smallest noise, with its yaw in the frame of the site. Return None if there is no
    body."""
    best: Body | None = None
    for n, _, o in of:
        if o.body is not None:
            best = surer_body(best, turned(o.body, solved.site_T_map[n, :3, :3]))
    return best


def _best_tag(solved: JointFrames, of: list[Row]) -> TagPose | None:
    """Return the rotation and size of a fiducial, from the session with the surest rotation. Return None for other
    objects."""
    best = min(((o.tag.sigma_deg, n, o.tag) for n, _, o in of if o.tag is not None), key=lambda one: one[:2], default=None)
    return None if best is None else best[2].turned(solved.site_T_map[best[1], :3, :3])
