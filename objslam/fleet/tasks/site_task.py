"""The last task of a site. It writes the folder of the site, as `objslam merge` does, and the part of the tables for the
site."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from objslam.errors import OutputError
from objslam.fleet.keys import key_of
from objslam.fleet.record import Record, record_name, result_name
from objslam.fleet.stores.open_store import open_store
from objslam.fleet.stores.store import Store, StoreError
from objslam.fleet.tasks.merge_task import Placed, SiteMap, load_node
from objslam.io.results.files import OBJECTS, SUMMARY, dump_json

if TYPE_CHECKING:
    from objslam.mapping.sites.merge import Island

WORK = "objslam.fleet.tasks.site_task:finish_site"
"""The name by which an engine finds the function of this task."""
SITES = "sites"
"""The name of the folder in the store that contains the folders of all sites."""
_STATE = "fleet.json"
"""The name of a file in the folder of a site. The file says from which sessions the folder and the tables of the site were
made."""
_OBJECTS, _SESSIONS = "objects.parquet", "sessions.parquet"
"""The names of the folders of the two tables. Each folder has one file for each site and day."""
_FILE = "part-0.parquet"  # The name of each file of a table.


@dataclass(frozen=True, slots=True)
class Member:
    """A session of a site. key: the key of its result. path: the path or URL of its log. robot, day: the names of its robot
    and its day. begin: the first stamp of its path, s. digest: the hash of its job."""

    key: str
    path: str
    robot: str
    day: str
    begin: float
    digest: str


@dataclass(frozen=True, slots=True)
class SiteTask:
    """The task of finishing a site whose tree is merged. store: the path or URL of the output. root: the key of the root of
    the tree. members: the sessions in the order of time. price: the price of one hour of one core, NaN if unknown."""

    store: str
    site: str
    root: str
    members: tuple[Member, ...]
    price: float = float("nan")


@dataclass(frozen=True, slots=True)
class SiteResult:
    """The counts of a site. islands, sessions: the numbers of all its islands and sessions. objects, gone: the numbers of
    present and of gone objects in the largest island. changed: whether this run wrote the site."""

    site: str
    islands: int
    sessions: int
    objects: int
    gone: int
    changed: bool


def folder_of(name: str) -> str:
    """Return a valid folder name for the name of a site or a day. Tables also use it as the value of a partition."""
    text = quote(name, safe=" ,;=()+-_~!'&$@")
    return text if text.strip(".") else text.replace(".", "%2E") or "_"


def finish_site(given: SiteTask) -> SiteResult:
    """Write the folder of a site, and the tables of those days that changed. Return the counts of the site. Raises the
    errors of `load_node` and of the store."""
    store = open_store(given.store)
    islands = load_node(store, given.root)
    at = f"{SITES}/{folder_of(given.site)}"
    state = _parse_state(store.read_many([state_name(given.site)]).get(state_name(given.site)))
    _write_folder(store, given, islands, at, int(state.get("islands", 0)))
    days = _write_tables(store, given, islands, state.get("days", {}))
    first = islands[0]
    sessions = sum(len(one.sessions) for one in islands)
    said = {
        **{"made_of": _made_of(given), "days": days, "islands": len(islands), "sessions": sessions},
        **{"objects": len(first.objects), "gone": len(first.objects.gone)},
        "members": [asdict(one) for one in given.members],
    }
    store.write(state_name(given.site), dump_json(said).encode())
    return _result(given.site, said, changed=True)


def state_name(site: str) -> str:
    """Return the name in the store of the file `_STATE` of a site."""
    return f"{SITES}/{folder_of(site)}/{_STATE}"


def earlier_members(state: bytes | None, digest: str) -> list[Member]:
    """Return the sessions of a site from earlier runs of the same job. state: the content of the site's file `state_name`,
    None if there is no such file. digest: the hash of the job."""
    try:
        members = [Member(**one) for one in _parse_state(state).get("members", [])]
    except TypeError:  # Another version wrote the file.
        return []
    return [one for one in members if one.digest == digest]


def as_before(given: SiteTask, state: bytes | None) -> SiteResult | None:
    """Return the counts of a site that an earlier run wrote from the same sessions and price. Return None if there is no
    such run.

    state: the content of the site's file `state_name`, None if there is no such file.
    """
    said = _parse_state(state)
    return _result(given.site, said, changed=False) if said.get("made_of") == _made_of(given) else None


def _made_of(given: SiteTask) -> str:
    members = (f"{one.key} {one.path} {one.robot} {one.day}" for one in given.members)
    return key_of("site", given.root, str(given.price), *members)


def _result(site: str, said: Mapping[str, Any], *, changed: bool) -> SiteResult:
    counts = {name: int(said[name]) for name in ("islands", "sessions", "objects", "gone")}
    return SiteResult(site=site, changed=changed, **counts)


def _parse_state(data: bytes | None) -> dict[str, Any]:
    """Return the content of the file `state_name` of a site. It is empty if the file is missing or damaged."""
    try:
        said = json.loads(data or b"{}")
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}


def _write_folder(store: Store, given: SiteTask, islands: Sequence[SiteMap], at: str, before: int) -> None:
    """Write the folder `at` of a site as `objslam merge` does, and the objects of the site as a table. before: the number of
    islands in the earlier run. The files of islands that no longer exist are deleted."""
    from objslam.fleet.tables import dump_objects, object_rows
    from objslam.output.site_folder import write_site

    paths = {one.key: one.path for one in given.members}
    order = {one.key: number for number, one in enumerate(given.members)}
    names = [paths[one.key] for one in given.members]
    found = [_island(one, order) for one in islands]
    apart = [f"the sessions are {len(found)} islands without objects in common"] if len(found) > 1 else []
    with tempfile.TemporaryDirectory(prefix="objslam-fleet-") as folder:
        out = Path(folder, "site")
        for number, written in enumerate(write_site(found, names, out, apart)):
            _seal_last(store, written, at if number == 0 else f"{at}/island_{number + 1}")
    for number in range(len(islands), before):
        for name in (SUMMARY, OBJECTS, "map.png"):
            store.remove(f"{at}/island_{number + 1}/{name}")
    rows = [row for k, one in enumerate(islands) for row in object_rows(one.objects, np.eye(4), {"island": k + 1})]
    store.write(f"{at}/objects.parquet", dump_objects(rows, lives=True))


def _seal_last(store: Store, folder: Path, at: str) -> None:
    """Upload the folder of an island. Write its summary.json last, because this file shows that the folder is complete."""
    seal = (folder / SUMMARY).read_bytes()
    (folder / SUMMARY).unlink()
    store.upload(folder, at)
    store.write(f"{at}/{SUMMARY}", seal)


def _island(found: SiteMap, order: Mapping[str, int]) -> Island:
    from objslam.mapping.sites.merge import Island

    return Island(
        found.objects,
        tuple(order[one.key] for one in found.sessions),
        np.array([one.site_T_session for one in found.sessions]),
        np.array([one.covariance for one in found.sessions]),
        np.array([one.log_odds for one in found.sessions]),
        tuple(one.common for one in found.sessions),
        {},
        {},
    )


def _write_tables(store: Store, given: SiteTask, islands: Sequence[SiteMap], before: Mapping[str, str]) -> dict[str, str]:
    """Write the tables of the days that changed, and remove the tables of days that no longer have a session.

    Return for each day a hash of the data in its files. before: the hashes that the earlier run returned.
    """
    placed = {one.key: (number + 1, one) for number, island in enumerate(islands) for one in island.sessions}
    days: dict[str, list[Member]] = {}
    for one in given.members:
        days.setdefault(one.day, []).append(one)
    made = {}
    for day, members in sorted(days.items()):
        parts = (f"{m.key} {m.path} {m.robot} {placed[m.key][0]} {placed[m.key][1]}" for m in members)
        made[day] = key_of("day", str(given.price), *parts)
        if before.get(day) != made[day]:
            _write_day(store, given, day, [(m, *placed[m.key]) for m in members])
    for day in set(before) - set(made):
        for table in (_OBJECTS, _SESSIONS):
            store.remove(_partition(table, given.site, day))
    return made


def _write_day(store: Store, given: SiteTask, day: str, members: Sequence[tuple[Member, int, Placed]]) -> None:
    from objslam.fleet.tables import dump_objects, dump_sessions, object_rows, session_row

    names = [record_name(m.key) for m, _, _ in members] + [f"{result_name(m.key)}/{OBJECTS}" for m, _, _ in members]
    content = store.read_many(names)
    sessions, objects = [], []
    for member, island, place in members:
        record = Record.parse(_content(content, record_name(member.key)), record_name(member.key))
        pose = place.site_T_session
        row = session_row(record, member.robot, island, pose, place.log_odds, place.common, given.price)
        sessions.append({**row, "source": member.path})
        name = f"{result_name(member.key)}/{OBJECTS}"
        more = {"session": member.key, "source": member.path, "robot": member.robot, "island": island}
        objects += object_rows(_objects(_content(content, name), name), pose, more)
    store.write(_partition(_OBJECTS, given.site, day), dump_objects(objects))
    store.write(_partition(_SESSIONS, given.site, day), dump_sessions(sessions))


def _objects(data: bytes, name: str) -> Any:
    from objslam.io.objects_json import parse_objects

    try:
        return parse_objects(json.loads(data))
    except (ValueError, KeyError, TypeError, OutputError) as error:
        raise StoreError(f"is damaged: {error}", where=name) from error


def _content(content: Mapping[str, bytes], name: str) -> bytes:
    if name not in content:
        raise StoreError("is missing: delete its record, and run the fleet again", where=name)
    return content[name]


def _partition(table: str, site: str, day: str) -> str:
    return f"{table}/site={folder_of(site)}/day={folder_of(day)}/{_FILE}"
