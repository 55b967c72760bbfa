"""The task that maps one log. It reads the log, maps it, and puts the result into the store.

The name of the folder of a result is the result's key, a hash of the log's content and the job. So a task that runs twice
writes the same files. The record of a log is written last. Other tasks read a result only if its record exists, so they
never use a part of a result.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from objslam import __version__
from objslam.errors import ObjslamError
from objslam.fleet.keys import OPTION_FILES, hash_log, key_of
from objslam.fleet.record import Parameter, Record, record_name, result_name, seen_name
from objslam.fleet.stores.open_store import is_remote, open_source, open_store
from objslam.fleet.stores.store import StoreError
from objslam.io.atomic_files import write_file

if TYPE_CHECKING:
    from objslam.api.result import Result
    from objslam.config import Settings
    from objslam.core.diagnostics import Ledger
    from objslam.core.types import Log
    from objslam.detection.detector import Detector
    from objslam.sources import SourceOptions

WORK = "objslam.fleet.tasks.map_task:map_one"
"""The name by which an engine finds the function of this task."""


@dataclass(frozen=True, slots=True)
class Job:
    """The data that the tasks of all logs of a fleet share.

    store: the path or URL of the output. options: the options of the sources. digest: the hash of everything that a result
    depends on, except its log. files: the key of each file, and its path or its name in a remote store. A key is the dotted
    key of a setting, the name of an option in `OPTION_FILES`, or `detector`. report: whether to write a report for each log.
    """

    store: str
    settings: Settings
    options: SourceOptions
    digest: str
    files: tuple[tuple[str, str], ...] = ()
    report: bool = False


@dataclass(frozen=True, slots=True)
class MapTask:
    """The task of mapping one log of a job. path: the path or URL of the log. task: the key of the log's fingerprint and the
    job (`seen_name`). again: whether to map the log even if an earlier run failed on the same content."""

    job: Job
    path: str
    task: str
    again: bool = False


def map_one(given: MapTask) -> Record:
    """Map one log, and return its record. The record of a log that cannot be mapped has an error.

    If the store already has a record for the same content, this record is returned. Only a record with an error is made
    again, and only if `again` is set. StoreError if the store or the source does not answer.
    """
    begin, cpu = time.monotonic(), time.process_time()
    store = open_store(given.job.store)
    with tempfile.TemporaryDirectory(prefix="objslam-fleet-") as folder:
        log = open_source(given.path).fetch(given.path, Path(folder, "log"))
        try:
            content = hash_log(log)
        except OSError as error:
            raise StoreError(f"cannot be read: {error.strerror or error}", where=given.path) from error
        key = key_of(content, given.job.digest)
        made = store.read_many([record_name(key)])
        record = Record.parse(made[record_name(key)], record_name(key)) if made else None
        if record is None or (record.error and given.again):
            record = Record(key, given.path, content, given.job.digest, __version__)
            out = Path(folder, "result")
            try:
                record = _mapped(given, log, out, record)
            except StoreError:
                raise
            except ObjslamError as error:
                record = replace(record, error=str(error).replace(str(log), given.path))
            else:
                record = replace(record, files=tuple(store.upload(out, result_name(key))))
            used, took = time.process_time() - cpu, time.monotonic() - begin
            record = replace(record, cpu=used, seconds=took, memory=_most_memory())
            store.write(record_name(key), record.dump())
    store.write(seen_name(given.task, key, not record.error), b"")
    return record


def _mapped(given: MapTask, log: Path, out: Path, record: Record) -> Record:
    """Map a log, and write its result into the folder `out`. Return the record with the values of this result. log: the
    local path. record: the record before the mapping."""
    from objslam.api.mapping import map_log
    from objslam.api.result import Result
    from objslam.core.diagnostics import Ledger
    from objslam.sources import read

    settings, options, detector = _inputs(given.job)
    ledger = Ledger()
    found = read(log, ledger, options)
    if detector is not None:
        found = _with_boxes(found, detector, settings, ledger)
    path = found.robot_path
    mapped, found = map_log(found, settings, ledger, None, lambda stage, done, total: None)
    result = Result.of(mapped, found, detected=detector is not None)
    result.summary["log_path"] = given.path  # `log` may be a copy that is deleted later.
    result.save(out)
    if given.job.report:
        from objslam.output.report.page import write_report

        write_report(out, log=log)
    size = sum(file.stat().st_size for file in out.iterdir())
    begin, end = (0.0, 0.0) if path is None else (float(path.stamps[0]), float(path.stamps[-1]))
    return replace(record, begin=begin, end=end, size=size, **_said(result))


def _with_boxes(log: Log, detector: Path, settings: Settings, ledger: Ledger) -> Log:
    """Return a log with the boxes of a detector. A process loads a model once, and keeps it for its next logs."""
    from objslam.detection import default_cache, detect_log

    return detect_log(log, _network(detector, settings.detector.model_dump_json()), settings, ledger, cache=default_cache())


@lru_cache(maxsize=1)
def _network(detector: Path, settings: str) -> Detector:
    from objslam import config
    from objslam.detection import load_detector

    return load_detector(detector, config.Detector.model_validate_json(settings))


def _said(result: Result) -> dict[str, Any]:
    parameters = (result.summary.get("calibration") or {}).get("parameters", {})
    return {
        "mode": result.summary["mode"],
        "verdict": result.assessment.level,
        "counts": dict(result.summary["counts"]),
        "warnings": result.warnings,
        "calibration": tuple(
            Parameter(name, one["value"], one["sigma"], one["unit"], one["observable"]) for name, one in parameters.items()
        ),
    }


def _inputs(job: Job) -> tuple[Settings, SourceOptions, Path | None]:
    """Return the settings and the source options of a job, with local paths of their files. Also return the path of the
    detector, None without one."""
    from objslam.config.settings import change_settings

    local = {key: _local_file(job.store, name) for key, name in job.files}
    detector = local.pop("detector", None)
    given = {name: type(getattr(job.options, name))(local.pop(name)) for name in OPTION_FILES if name in local}
    options = replace(job.options, **given) if given else job.options
    return change_settings(job.settings, {key: str(path) for key, path in local.items()}), options, detector


@lru_cache(maxsize=16)
def _local_file(store: str, name: str) -> Path:
    """Return the local path of a file of a job. Each process copies a file of a remote store once."""
    if not is_remote(store):
        return Path(name)
    from objslam.detection import default_cache

    data = open_store(store).read(name)
    cache = default_cache()
    if cache is None:
        raise StoreError("there is no folder for the files of the settings", where=name)
    folder = cache.parent / "fleet" / sha256(data).hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / name.rpartition("/")[2]
    write_file(file, data)
    return file


def _most_memory() -> int:
    """Return the peak RAM of this process, bytes."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
