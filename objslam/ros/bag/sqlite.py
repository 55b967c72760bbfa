"""Read ROS 2 bags that are sqlite3 databases, in rowid order. A damaged database is read page by page."""

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from objslam.errors import LogError
from objslam.ros.bag.records import LANGUAGES, MAX_RECORD, Connection, FileReport, Messages, Wanted, make_connection
from objslam.ros.bag.sqlite_pages import missing_pages, rows_of_pages

MAGIC = b"SQLite format 3\0"


def read_sqlite(path: Path, report: FileReport, wanted: Wanted) -> Messages:
    """Yield the messages of the wanted topics in rowid order. Raises LogError if the file is not a database of messages.

    All whole rows of a damaged file are read. A killed recorder leaves a journal of SQLite beside the file. This journal is
    applied to a temporary copy of the file.
    """
    with _settled(path, report) as (file, mode), _open(file, mode, path) as database:
        topics = _read_topics(database, path)
        keys = frozenset(key for key, connection in topics.items() if wanted(connection))
        for _, key, stamp, data in _rows(database, file, keys, report):
            if type(stamp) is int and type(data) is bytes:
                report.messages += 1
                yield topics[key], stamp, data
            else:
                report.damage("rows that are not messages", 1)


@contextmanager
def _settled(path: Path, report: FileReport) -> Iterator[tuple[Path, str]]:
    """Yield the file to read, and the mode in which SQLite opens it. If a killed recorder left a journal of SQLite, the
    file is a temporary copy."""
    names = (path.with_name(path.name + end) for end in ("-wal", "-journal"))
    siblings = [file for file in names if file.is_file() and file.stat().st_size]
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
            raise LogError(message, where=str(path), hint=f"is the disk full at {tempfile.gettempdir()}?") from error
        yield copy, "mode=rw"


@contextmanager
def _open(file: Path, mode: str, path: Path) -> Iterator[sqlite3.Connection]:
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?{mode}", uri=True, isolation_level=None)) as database:
            database.text_factory = lambda text: text.decode("utf-8", "replace")
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA writable_schema = ON")  # Needed to open a truncated file.
            if mode == "mode=rw":
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            yield database
    except sqlite3.Error as error:
        raise LogError(f"not a database that can be read: {error}", where=str(path)) from error


def _read_topics(database: sqlite3.Connection, path: Path) -> dict[int, Connection]:
    # Views and virtual tables (rootpage 0) are excluded, because they can generate endless rows.
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")}
    if not {"topics", "messages"} <= tables:
        raise LogError("not a ROS 2 bag: the database has no tables of topics and messages", where=str(path))
    columns = {name for _, name, *_ in database.execute("PRAGMA table_info(messages)")}
    if not {"topic_id", "timestamp", "data"} <= columns:
        raise LogError("not a ROS 2 bag: its table of messages lacks a topic, a time or the data", where=str(path))
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (LANGUAGES.get(encoding, ""), text) for name, encoding, text in database.execute(query)}
    topics = {}
    for key, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
        language, text = definitions.get(kind, ("", ""))
        topics[key] = make_connection(str(name), str(kind), str(encoding), text, language)
    return topics


def _rows(
    database: sqlite3.Connection, file: Path, topics: frozenset[int], report: FileReport
) -> Iterator[tuple[int, int, Any, Any]]:
    """Yield the rows of the topics in rowid order. A row is rowid, topic id, recording time (ns) and message.

    A cut-off file is read page by page. If the database fails, the rest of the file is read page by page.
    """
    marks = ", ".join("?" * len(topics))
    last = -1
    pages, missing = missing_pages(file)
    if missing:  # SQLite would fill the page that is cut off with zeros.
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
        report.damage("rows between other rows are missing", last - first - found)
