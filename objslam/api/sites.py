"""Register, join and compare the maps of several sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

from objslam.api.result import Result
from objslam.association.registration import object_maps
from objslam.association.registration.map_registration import Registration
from objslam.core import object_map
from objslam.frontend.up import on_its_side
from objslam.io.results.files import SUMMARY
from objslam.io.results.object_map import ObjectMap
from objslam.io.results.read import load_summary
from objslam.mapping.sites.compare import Comparison, compare
from objslam.mapping.sites.merge import Island, merge_sessions
from objslam.mapping.sites.session import Session

Given = Result | object_map.ObjectMap | str | PathLike[str]
"""A session as a user gives it: a result, a map alone, or the path of a result folder, a site or an objects.json."""


def merge(sessions: Sequence[Given]) -> tuple[Island, ...]:
    """Join the maps of several sessions to one map of the site. The map of each session has a frame of its own.

    sessions: the sessions in the order of time. Return one island for each group of sessions that share objects. The largest
    island comes first. `Island.objects` is its map, in the frame of its first session. `MapObject.life` says what became of
    each object. ValueError if there is no session, or if `sessions` is one path. OutputError if a path cannot be read.
    """
    if isinstance(sessions, (str, PathLike)):
        raise ValueError(f"merge needs a sequence of sessions, got the one path {str(sessions)!r}")
    if not sessions:
        raise ValueError("merge needs at least one session")
    found = merge_sessions([_session(one, f"session {number}") for number, one in enumerate(sessions)])
    return tuple(replace(one, objects=ObjectMap.of(one.objects)) for one in found)


def diff(a: Given, b: Given) -> Comparison:
    """Compare a map with the map of a later session. Return which objects are confirmed, moved, gone, new or unconfirmed.

    The later session should be the result of an offline run. A map alone and the result of a live session do not say what
    was in view. With such a later session, no object counts as gone or moved (`Comparison.has_views`). If the registration
    of the maps is refused, `changes` is empty, and `reason` says why. OutputError if a path cannot be read.
    """
    return compare(_session(a, "the first map"), _session(b, "the other map"))


def register(a: Given, b: Given) -> Registration:
    """Return the transform b_T_a from the frame of map a to the frame of map b, with its evidence. The relative positions of
    the objects give the transform.

    Both frames have z up. The transform turns about z and shifts along x, y and z, m. Only resolved objects are used.
    `matches` has indices into the objects of a and b. Use the transform only if `accepted` is true. OutputError if a path
    cannot be read.
    """
    return object_maps.register(_objects(a), _objects(b))


def load_session(path: Path) -> Session:
    """Return the session of a result folder, a site or an objects.json. OutputError names what is missing or damaged."""
    return Session.load(path)


def warnings_of(sessions: Sequence[Session], islands: Sequence[Island]) -> list[str]:
    """Return the warnings of a merge. They name sessions that share no objects with others, maps whose z axis does not point
    up, and results that contain the objects of another map."""
    found = []
    if len(islands) > 1:
        apart = "; ".join(", ".join(sessions[s].name for s in one.sessions) for one in islands)
        found.append(f"the sessions are {len(islands)} islands without objects in common: {apart}")
    for session in sessions:
        if lies := on_its_side({session.name: session.up}):
            found.append(lies)
        folder = Path(session.name)
        told = load_summary(folder).get("localisation") if (folder / SUMMARY).is_file() else None
        if told and told["localised"]:
            what = f"{session.name} was localised in a map, and has the objects of that map in its own"
            found.append(f"{what}: merge a run without --map, so that the map does not count twice")
    return found


def _objects(given: Given) -> object_map.ObjectMap:
    if isinstance(given, object_map.ObjectMap):
        return given
    return given.objects if isinstance(given, Result) else ObjectMap.load(given)


def _session(given: Given, name: str) -> Session:
    if isinstance(given, object_map.ObjectMap):
        return Session(name, given)
    if not isinstance(given, Result):
        return Session.load(given)
    if given.folder is not None:
        return Session.load(given.folder)
    return Session(name, given.objects, given.views, given.rays, up=given.summary.get("up", "z"))
