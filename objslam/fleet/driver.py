"""The driver of a fleet. It maps the logs without a result on an engine, merges each site, and writes the tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from objslam.fleet.engines.local_engine import Answer, Engine
from objslam.fleet.keys import key_of
from objslam.fleet.logs import LogPlace
from objslam.fleet.record import SEEN, Parameter, Record, parse_seen, record_name
from objslam.fleet.stores.open_store import open_store
from objslam.fleet.stores.store import Store
from objslam.fleet.tasks import map_task, merge_task, site_task
from objslam.fleet.tasks.map_task import Job, MapTask
from objslam.fleet.tasks.merge_task import MergeTask
from objslam.fleet.tasks.site_task import Member, SiteResult, SiteTask
from objslam.fleet.tree import MERGES, tree_of

UNDATED = "undated"
"""The name of the day of a log whose path names no day and whose stamps are not Unix time."""
_CHUNK = 500
"""The largest number of records that one call reads. With a larger number, there are fewer calls, and they take more
memory."""

Stage = Literal["mapping", "merging"]
Tell = Callable[[Stage, int, int, int, int], None]
"""A function that reports progress. Its first argument is the stage. The other four are numbers of tasks of this stage:
succeeded, failed, running and all."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """The summary of a mapped log.

    place: where the log was found. key: the key of the result. day: the name of the day. begin: the first stamp of the path,
    s. objects, warnings: the numbers of objects and of warnings. verdict: good, check or bad. seconds: the duration of the
    task, s. calibration: the shared errors. report: whether the result has a report.html. new: whether this run mapped the
    log.
    """

    place: LogPlace
    key: str
    day: str
    begin: float
    objects: int
    verdict: str
    warnings: int
    seconds: float
    calibration: tuple[Parameter, ...]
    report: bool
    new: bool


@dataclass(frozen=True, slots=True)
class Failure:
    """A log or a site that failed. name: the path of the log, or the name of the site. place: where the log was found, None
    for a site.

    kind: `log` if something is wrong with the log, `site` for a site. For any other failure, it is the kind of the task's
    `Answer`.
    """

    name: str
    kind: str
    error: str
    place: LogPlace | None = None


@dataclass
class FleetResult:
    """The outcome of a run of a fleet: its logs, failures and sites. The run adds each entry when it is known.

    copies: the number of mapped logs that repeat the content of another log of their site. A merge uses each content once.
    """

    mapped: list[Mapped] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    sites: list[SiteResult] = field(default_factory=list)
    copies: int = 0

    @property
    def new(self) -> int:
        """The number of logs that this run mapped."""
        return sum(one.new for one in self.mapped)


def run_fleet(
    job: Job,
    logs: Sequence[LogPlace],
    engine: Engine,
    *,
    price: float = float("nan"),
    again: bool = False,
    tell: Tell = lambda stage, done, failed, running, total: None,
    merge_engine: Engine | None = None,
) -> FleetResult:
    """Map the logs that have no result yet, merge each site, and write all tables. Return the outcome.

    Args:
        job: the data that the tasks of all logs share.
        logs: all logs of the run.
        engine: the engine of the mapping.
        price: the price of one hour of one core, for the column cost. NaN if unknown.
        again: whether to try again the logs that failed before because of their content.
        tell: a function that is called at the start of the mapping, and whenever a task ends.
        merge_engine: the engine of the merges, if they need other resources than the mapping. The default is `engine`.
    Raises:
        StoreError: the output cannot be read or written.
    """
    store = open_store(job.store)
    found = FleetResult()
    _map_logs(job, logs, engine, store, again, found, tell)
    found.mapped.sort(key=lambda one: (one.place.site, one.begin, one.place.path))
    _merge_sites(job, merge_engine or engine, store, price, found, tell)
    _write_failures(store, found.failures)
    return found


def _map_logs(
    job: Job, logs: Sequence[LogPlace], engine: Engine, store: Store, again: bool, found: FleetResult, tell: Tell
) -> None:
    """Map the logs that have no result yet, and add the outcome of each log to `found`."""
    seen = parse_seen(store.names(SEEN))
    places: dict[str, LogPlace] = {}
    known: list[tuple[LogPlace, str]] = []
    for log in logs:
        task = key_of(log.fingerprint, job.digest)
        if task in seen and (seen[task][1] or not again):
            known.append((log, seen[task][0]))
        else:
            places[task] = log
    done = failed = 0
    for place, record in _read_records(store, known):
        if record is None:
            places[key_of(place.fingerprint, job.digest)] = place
            continue
        failed += _add(found, place, record, new=False)
        done += 1
    tell("mapping", done - failed, failed, 0, len(logs))
    tasks = (MapTask(job, place.path, task, again) for task, place in places.items())
    for answer in engine(map_task.WORK, tasks):
        place = places[answer.argument.task]
        if isinstance(answer.value, Record):
            failed += _add(found, place, answer.value, new=True)
        else:
            found.failures.append(Failure(place.path, answer.kind, answer.message, place))
            failed += 1
        done += 1
        tell("mapping", done - failed, failed, answer.running, len(logs))


def _read_records(store: Store, known: Sequence[tuple[LogPlace, str]]) -> Iterator[tuple[LogPlace, Record | None]]:
    """Yield each log with its record. The record is None if the store no longer has it. known: the logs with their keys."""
    for at in range(0, len(known), _CHUNK):
        part = known[at : at + _CHUNK]
        content = store.read_many(record_name(key) for _, key in part)
        for place, key in part:
            data = content.get(record_name(key))
            yield place, None if data is None else Record.parse(data, record_name(key))


def _add(found: FleetResult, place: LogPlace, record: Record, *, new: bool) -> bool:
    """Add the outcome of a record to `found`. Return whether the log of the record failed."""
    if record.error:
        found.failures.append(Failure(place.path, "log", record.error, place))
        return True
    found.mapped.append(
        Mapped(
            place,
            record.key,
            place.day or _day(record.begin),
            record.begin,
            (record.counts or {}).get("objects", 0),
            record.verdict,
            len(record.warnings),
            record.seconds,
            record.calibration,
            "report.html" in record.files,
            new,
        )
    )
    return False


def _day(stamp: float) -> str:
    from objslam.core.validity import is_date

    return datetime.fromtimestamp(stamp, UTC).strftime("%Y-%m-%d") if is_date(stamp) else UNDATED


def _merge_sites(job: Job, engine: Engine, store: Store, price: float, found: FleetResult, tell: Tell) -> None:
    """Merge the tree of each site, and write the folder and tables of each site. Add the outcome to `found`.

    All sites are merged at the same time, level by level.
    """
    here: dict[str, dict[str, Member]] = {}
    for one in found.mapped:
        member = Member(one.key, one.place.path, one.place.robot, one.day, one.begin, job.digest)
        here.setdefault(one.place.site, {}).setdefault(one.key, member)
    found.copies = len(found.mapped) - sum(map(len, here.values()))
    states = store.read_many(site_task.state_name(site) for site in here)
    paths = {one.place.path for one in found.mapped} | {one.name for one in found.failures}
    sites = {
        site: _with_earlier(members, states.get(site_task.state_name(site)), job.digest, paths)
        for site, members in here.items()
    }
    trees = {site: tree_of(list(members)) for site, members in sites.items()}
    there = {name.removesuffix(".json") for name in store.names(MERGES)}
    wrong: dict[str, str] = {}
    total = sum(len({n.key for level in levels for n in level} - there) for levels in trees.values()) + len(sites)
    done = 0

    def run(work: str, tasks: dict[Any, str]) -> Iterator[Answer]:
        """Run tasks on the engine, and yield their answers. work: the name of their function. tasks: the site of each
        task."""
        nonlocal done
        for answer in engine(work, tasks):
            done += 1
            if answer.value is None:
                wrong.setdefault(tasks[answer.argument], answer.message)
            tell("merging", done - len(wrong), len(wrong), answer.running, total)
            yield answer

    for depth in range(max(map(len, trees.values()), default=0)):
        nodes = [(s, n) for s, levels in trees.items() if depth < len(levels) and s not in wrong for n in levels[depth]]
        tasks = {MergeTask(job.store, node): site for site, node in nodes if node.key not in there}
        for answer in run(merge_task.WORK, tasks):
            there.add(answer.argument.node.key)
    last: dict[SiteTask, str] = {}
    for site, members in sites.items():
        task = SiteTask(job.store, site, trees[site][-1][0].key, tuple(members.values()), price)
        if (before := site_task.as_before(task, states.get(site_task.state_name(site)))) is not None:
            found.sites.append(before)
        elif site not in wrong:
            last[task] = site
    total += len(last) - len(sites)
    found.sites.extend(answer.value for answer in run(site_task.WORK, last) if answer.value is not None)
    found.sites.sort(key=lambda one: one.site)
    found.failures.extend(Failure(site, "site", message) for site, message in sorted(wrong.items()))


def _with_earlier(members: dict[str, Member], state: bytes | None, digest: str, paths: set[str]) -> dict[str, Member]:
    """Return all sessions of a site by key, in the order of time: `members` of this run, and sessions of earlier runs.

    state: the content of the site's file `state_name`, None if there is no such file. digest: the hash of the job. paths:
    the paths of all logs of this run, mapped or not. An earlier session whose path is in `paths` is left out, because this
    run replaces it.
    """
    before = {one.key: one for one in site_task.earlier_members(state, digest) if one.path not in paths}
    return dict(sorted((before | members).items(), key=lambda entry: (entry[1].begin, entry[1].path)))


def _write_failures(store: Store, failures: list[Failure]) -> None:
    from objslam.fleet.tables import dump_failures

    failures.sort(key=lambda one: (one.kind == "site", one.name))
    rows = [
        {
            **{"source": one.name, "kind": one.kind, "error": one.error},
            **{name: getattr(one.place, name, "") for name in ("site", "robot", "day")},
        }
        for one in failures
    ]
    store.write("failed.parquet", dump_failures(rows))
