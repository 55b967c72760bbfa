"""ROS 2 bags of the sqlite3 storage, read by rowid; where the database is damaged, page by page."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from objslam.errors import LogError
from objslam.ros.bag.records import LANGUAGES, MAX_RECORD, Connection, FileReport, Messages, plain, type_name
from objslam.ros.bag.sqlite_pages import missing_pages, rows_of_pages

MAGIC = b"SQLite format 3\0"


def read_sqlite(path: Path, report: FileReport, wanted: Callable[[Connection], bool]) -> Messages:
    """The messages of the wanted topics of a database, in the order of their rowids.

    Of a file that is cut off or has damaged pages, every row is read that is whole. The write-ahead log or rollback journal
    of a recorder that was killed is applied to a copy in the folder for temporary files: the file itself is never touched.
    LogError where there is no table of topics and messages.
    """
    with _settled(path, report) as (file, mode), _open(file, mode, path) as database:
        topics = _read_topics(database, path)
        keys = frozenset(key for key, connection in topics.items() if wanted(connection))
        for _, key, stamp, data in _rows(database, file, keys, report):
            if type(stamp) is int and type(data) is bytes:
                report.messages += 1
                yield topics[key], stamp, data
            else:
                report.damage("rows that are no messages", 1)


@contextmanager
def _settled(path: Path, report: FileReport) -> Iterator[tuple[Path, str]]:
    """The file, or a copy of it that what the recorder left beside it is applied to, and how to open it."""
    siblings = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
    siblings = [file for file in siblings if file.is_file() and file.stat().st_size]
    if not siblings:
        yield path, "mode=ro&immutable=1"
        return
    with tempfile.TemporaryDirectory(prefix="objslam_bag_") as folder:
        try:
            copy = Path(shutil.copyfile(path, Path(folder, "bag.db3")))
            for sibling in siblings:
                shutil.copyfile(sibling, copy.with_name(copy.name + sibling.name.removeprefix(path.name)))
                report.damage(f"never closed, {sibling.name} was applied to a copy", 0)
        except OSError as error:
            message = f"cannot be copied to be repaired: {error.strerror or error}"
            raise LogError(message, where=str(path), hint=f"is there room in {tempfile.gettempdir()}?") from error
        yield copy, "mode=rw"


@contextmanager
def _open(file: Path, mode: str, path: Path) -> Iterator[sqlite3.Connection]:
    database = None
    try:
        database = sqlite3.connect(f"{file.resolve().as_uri()}?{mode}", uri=True, isolation_level=None)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD)
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA writable_schema = ON")  # else a file that is shorter than it says is not opened at all
        if mode == "mode=rw":
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        yield database
    except sqlite3.Error as error:
        raise LogError(f"not a database that can be read: {error}", where=str(path)) from error
    finally:
        if database is not None:
            database.close()


def _read_topics(database: sqlite3.Connection, path: Path) -> dict[int, Connection]:
    # rootpage > 0: a view or a virtual table could make up rows without end
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")}
    if not {"topics", "messages"} <= tables:
        raise LogError("not a ROS 2 bag: the database has no tables of topics and messages", where=str(path))
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (LANGUAGES.get(encoding, ""), text) for name, encoding, text in database.execute(query)}
    topics = {}
    for key, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        language, text = definitions.get(kind, ("", ""))
        topics[key] = Connection(plain(str(name)), type_name(str(kind)), str(encoding), text if language else "", language)
    return topics


def _rows(
    database: sqlite3.Connection, file: Path, topics: frozenset[int], report: FileReport
) -> Iterator[tuple[int, int, Any, Any]]:
    """Rows of the topics in the order of their rowids; from the first that the database fails on, page by page."""
    marks = ", ".join("?" * len(topics))
    last = -1
    pages, missing = missing_pages(file)
    if missing:  # the database would make zeros of the page that the cut goes through
        report.damage(f"cut off at byte {file.stat().st_size}, {missing} of {pages + missing} pages are missing")
    else:
        try:
            query = f"SELECT rowid, topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY rowid"
            for row in database.execute(query, tuple(topics)):
                yield row
                last = row[0]
            return
        except sqlite3.DatabaseError as error:
            report.damage(f"the database fails after row {max(last, 0)} ({error}), the rest was read page by page")
    names = [name for _, name, *_ in database.execute("PRAGMA table_info(messages)")]
    first, found = max(last, 0), 0
    for row in rows_of_pages(file, (names.index("topic_id"), names.index("timestamp"), names.index("data")), topics, last):
        yield row
        last, found = row[0], found + 1
    if last - first > found:
        report.damage("rows between others are gone", last - first - found)
