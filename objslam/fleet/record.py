"""The record of a log. It contains what a fleet keeps of one run besides the result. It is written after the result, so it
shows that the result is complete."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from objslam.fleet.stores.store import StoreError
from objslam.io.results.files import dump_json

RESULTS, RECORDS, SEEN = "results", "records", "seen"
"""The names of three folders in the store. These folders contain the results by key, the records of the logs, and the empty
files that `seen_name` names."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One shared error that a run estimated. value, sigma: the estimate and its standard deviation, in `unit`. known:
    whether the log determines the error."""

    name: str
    value: float
    sigma: float
    unit: str
    known: bool


@dataclass(frozen=True, slots=True)
class Record:
    """The outcome of one log.

    key: the hash of the content of the log, the job and the version. source: the path or URL of the log. log: the hash of
    the content of the log. settings: the digest of the job. error: what is wrong with the log, empty if it was mapped.
    begin, end: the first and the last stamp of the path, s. verdict: good, check or bad. cpu, seconds: the processor time
    and the duration of the task, s. memory: the peak RAM of the task's process since the process started, bytes. size: the
    size of the result, bytes. files: the names of the files in the result.
    """

    key: str
    source: str
    log: str
    settings: str
    version: str
    error: str = ""
    mode: str = ""
    begin: float = 0.0
    end: float = 0.0
    verdict: str = ""
    counts: Mapping[str, int] | None = None
    calibration: tuple[Parameter, ...] = ()
    warnings: tuple[str, ...] = ()
    cpu: float = 0.0
    seconds: float = 0.0
    memory: int = 0
    size: int = 0
    files: tuple[str, ...] = ()

    def dump(self) -> bytes:
        """Return the content of the file of the record."""
        return dump_json(asdict(self)).encode()

    @classmethod
    def parse(cls, data: bytes, where: str) -> Self:
        """Return the record in the content of a file. where: the name of the file for messages. StoreError if the content is
        damaged."""
        try:
            said: dict[str, Any] = json.loads(data)
            said["calibration"] = tuple(Parameter(**one) for one in said["calibration"])
            said |= {name: tuple(said[name]) for name in ("warnings", "files")}
            return cls(**said)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise StoreError("not the record of a fleet: delete it, and its log is mapped again", where=where) from error


def record_name(key: str) -> str:
    """Return the name of the file of a record in the store. key: the key of the record."""
    return f"{RECORDS}/{key}.json"


def result_name(key: str) -> str:
    """Return the name of the folder of a result in the store. key: the key of the result."""
    return f"{RESULTS}/{key}"


def seen_name(task: str, key: str, good: bool) -> str:
    """Return the name of an empty file in the store. The name says which key a log has, and whether the log was mapped
    (`good`).

    task: the key of the log's fingerprint and the job. Unlike `key`, it is known before the log is read.
    """
    return f"{SEEN}/{task}.{key}.{'done' if good else 'failed'}"


def parse_seen(names: list[str]) -> dict[str, tuple[str, bool]]:
    """Return for each task the key of its log, and whether the log was mapped. names: the names of the files in the folder
    `SEEN`."""
    found: dict[str, tuple[str, bool]] = {}
    for name in names:
        task, _, rest = name.partition(".")
        key, _, state = rest.partition(".")
        if state in ("done", "failed") and (task not in found or state == "done"):
            found[task] = key, state == "done"
    return found
