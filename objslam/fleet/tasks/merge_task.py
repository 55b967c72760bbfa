"""The task that merges one node of the tree of a site. It merges a group of sessions, or the islands of two nodes.

An island is a group of sessions that share objects. It has one map. A node may have several islands.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.fleet.record import result_name
from objslam.fleet.stores.local_store import LocalStore
from objslam.fleet.stores.open_store import open_store
from objslam.fleet.stores.store import Store, StoreError
from objslam.fleet.tree import Node, node_name
from objslam.io.results import files

if TYPE_CHECKING:
    from objslam.core.object_map import ObjectMap
    from objslam.mapping.sites.merge import Island
    from objslam.mapping.sites.session import Session, Visit

WORK = "objslam.fleet.tasks.merge_task:merge_one"
"""The name by which an engine finds the function of this task."""
_SESSION_FILES = (files.OBJECTS, files.VIEWS, files.RAYS)
"""The names of the files of a result that a merge reads."""


@dataclass(frozen=True, slots=True)
class MergeTask:
    """The task of merging one node of the tree of a site. store: the path or URL of the output."""

    store: str
    node: Node


@dataclass(frozen=True)
class Placed:
    """The pose of a session in the frame of its island.

    key: the key of the session's result. site_T_session: (4, 4) the pose, m. covariance: (4, 4) the covariance of x, y, z
    (m) and yaw (rad) of the pose. log_odds: the log odds of the registration that joined the session to earlier sessions,
    NaN for the first session of the island. If a part with several sessions was joined, the first session of the part has
    these log odds. The other sessions of the part keep their own. common: the number of the session's objects that other
    sessions found too, counted in the first merge that finds any.
    """

    key: str
    site_T_session: Floats
    covariance: Floats
    log_odds: float
    common: int


@dataclass(frozen=True)
class SiteMap:
    """One island of a node. objects: its map. sessions: its sessions in the order of time. The first session gives the frame
    of the map."""

    objects: ObjectMap
    sessions: tuple[Placed, ...]


def merge_one(given: MergeTask) -> int:
    """Merge the node of a task, and write it into the store. Return the number of its islands.

    OutputError or StoreError if a result or a node below this node is damaged, StoreError if the store does not answer.
    """
    from objslam.mapping.sites.merge import merge_sessions

    store = open_store(given.store)
    with tempfile.TemporaryDirectory(prefix="objslam-fleet-") as folder:
        load = partial(load_session, store, Path(folder))
        if given.node.below:
            parts = [part for key in given.node.below for part in load_node(store, key)]
            inputs = [_session(part, load) for part in parts]
        else:
            parts = [_alone(key) for key in given.node.sessions]
            inputs = [load(key) for key in given.node.sessions]
        islands = [_joined(one, parts, given.node.sessions) for one in merge_sessions(inputs)]
    islands.sort(key=lambda one: -len(one.sessions))
    store.write(node_name(given.node.key), _dump(islands))
    return len(islands)


def load_node(store: Store, key: str) -> list[SiteMap]:
    """Return the islands of a node. key: the key of the node. StoreError if the node's file is missing or damaged,
    OutputError if an object is invalid."""
    from objslam.io.objects_json import parse_objects

    try:
        said = json.loads(store.read(node_name(key)))
        return [
            SiteMap(parse_objects(one["objects"]), tuple(_placed(session) for session in one["sessions"])) for one in said
        ]
    except FileNotFoundError as error:
        raise StoreError("a part of the site is missing: run the fleet again", where=node_name(key)) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError("is damaged: delete it, and run the fleet again", where=node_name(key)) from error


def load_session(store: Store, folder: Path, key: str) -> Session:
    """Return the session of a result. key: the key of the result. folder: a local folder for copies of the files of a remote
    store."""
    from objslam.mapping.sites.session import Session

    with _result_folder(store, folder, key) as at:
        return replace(Session.load(at), name=key)


@contextmanager
def _result_folder(store: Store, folder: Path, key: str) -> Iterator[Path]:
    """Yield a local folder with the files of a result that a merge reads. folder, key: as in `load_session`."""
    if isinstance(store, LocalStore):
        yield Path(store.url, result_name(key))
        return
    at = folder / key
    at.mkdir(exist_ok=True)
    for name, data in store.read_many(f"{result_name(key)}/{one}" for one in _SESSION_FILES).items():
        (at / name.rpartition("/")[2]).write_bytes(data)
    yield at


def _session(part: SiteMap, load: Any) -> Session:
    """Return an island as one session of the next merge. load: a function that returns the session of a key. The sessions of
    the island are loaded only if the merge needs to know whether they missed an object."""
    from objslam.core.geometry import inverse
    from objslam.mapping.sites.session import Session, Visit

    def visits() -> tuple[Visit, ...]:
        return tuple(Visit(load(one.key), inverse(one.site_T_session)) for one in part.sessions)

    return Session(part.sessions[0].key, part.objects, visits=visits)


def _alone(key: str) -> SiteMap:
    """Return one session as an island in the session's own frame. key: the key of the session's result. The island has no
    objects, because the merge reads the objects from the result."""
    from objslam.core.object_map import ObjectMap

    return SiteMap(ObjectMap(()), (Placed(key, np.eye(4), np.zeros((4, 4)), np.nan, 0),))


def _joined(island: Island, parts: Sequence[SiteMap], order: Sequence[str]) -> SiteMap:
    """Return an island of a merge with all sessions that it contains.

    parts: the islands that were merged. `island.sessions` has indices into them. order: the keys of the sessions of all
    parts, in the order of time.
    """
    rank = {key: number for number, key in enumerate(order)}
    placed = []
    for row, number in enumerate(island.sessions):
        site_T_part, covariance = island.site_T_session[row], island.covariance[row]
        for k, one in enumerate(parts[number].sessions):
            placed.append(
                Placed(
                    one.key,
                    site_T_part @ one.site_T_session,
                    _compound(site_T_part, covariance, one),
                    float(island.log_odds[row]) if k == 0 else one.log_odds,
                    one.common or island.common[row],
                )
            )
    return SiteMap(island.objects, tuple(sorted(placed, key=lambda one: rank[one.key])))


def _compound(site_T_part: Floats, covariance: Floats, one: Placed) -> Floats:
    """Return the covariance (4, 4), of x, y, z (m) and yaw (rad), of the pose of a session in the site.

    site_T_part, covariance: (4, 4) the pose of the session's part in the site, and the covariance of this pose. one: the
    pose of the session in the part. An error of the part's yaw turns the session around the origin of the part.
    """
    turn = np.eye(4)
    turn[:3, :3] = site_T_part[:3, :3]
    arm = site_T_part[:3, :3] @ one.site_T_session[:3, 3]
    lever = np.eye(4)
    lever[0, 3], lever[1, 3] = -arm[1], arm[0]
    result: Floats = lever @ covariance @ lever.T + turn @ one.covariance @ turn.T
    return result


def _dump(islands: Sequence[SiteMap]) -> bytes:
    from objslam.io.objects_json import dump_objects
    from objslam.io.results.files import dump_json

    said = [
        {
            "objects": json.loads(dump_objects(one.objects)),
            "sessions": [
                {
                    "key": s.key,
                    "site_T_session": s.site_T_session,
                    "covariance": s.covariance,
                    "log_odds": s.log_odds,
                    "common": s.common,
                }
                for s in one.sessions
            ],
        }
        for one in islands
    ]
    return dump_json(said).encode()


def _placed(said: Mapping[str, Any]) -> Placed:
    pose, covariance = (np.array(said[name], dtype=np.float64).reshape(4, 4) for name in ("site_T_session", "covariance"))
    odds = np.nan if said["log_odds"] is None else float(said["log_odds"])
    return Placed(str(said["key"]), pose, covariance, odds, int(said["common"]))
