"""Text files of a log, read line by line without trust: what is malformed is dropped and counted by file and line."""

from __future__ import annotations

import gzip
import io
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.errors import LogError

_PLACES = 3  # as many places as a ledger keeps
_MAX_UNPACKED = 1 << 30  # bytes; a day of poses at 200 Hz


@dataclass(frozen=True)
class Table:
    """Numbers read from a text file.

    values: (N, C), finite. lines: (N,) line numbers in the file, from 1. rows: (N,) which row of the file each one is, from
    0, malformed rows counted too: files that belong together row by row stay in step.
    """

    values: Floats
    lines: Ints
    rows: Ints


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what the file system refuses into a LogError that names the file, `path` where the system names none."""
    try:
        yield
    except OSError as error:
        where = error.filename if isinstance(error.filename, str) else str(path)
        raise LogError(f"cannot be read: {error.strerror or error}", where=where) from error


def read_bytes(path: Path) -> bytes:
    """The content of a regular file, unpacked if its name ends in .gz; LogError names the file otherwise."""
    with reading(path):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            what = "is a folder" if stat.S_ISDIR(mode) else "is not a regular file"
            raise LogError(f"{what}, a file was expected", where=str(path))
        data = path.read_bytes()
    if path.suffix != ".gz":
        return data
    try:
        with gzip.open(io.BytesIO(data)) as packed:
            unpacked = packed.read(_MAX_UNPACKED + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise LogError(f"not gzip, or cut off: {error}", where=str(path)) from error
    if len(unpacked) > _MAX_UNPACKED:
        raise LogError(f"unpacks to more than {_MAX_UNPACKED >> 20} MiB", where=str(path))
    return unpacked


def read_lines(path: Path, ledger: Ledger) -> list[tuple[int, str]]:
    """The lines of a UTF-8 text file that hold something, with their numbers from 1, stripped; '#' lines are comments."""
    return split_lines(read_bytes(path), str(path), ledger)


def split_lines(data: bytes, place: str, ledger: Ledger) -> list[tuple[int, str]]:
    """As `read_lines`, from bytes; `place` names where they came from. Lines that are not UTF-8 are dropped and counted."""
    damaged = False
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        damaged = True
        text = data.decode("utf-8-sig", errors="replace")
    lines = []
    for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1):
        content = line.strip()
        if damaged and "\ufffd" in content:
            ledger.drop("line that is not UTF-8 text", where=f"{place}:{number}")
        elif content and not content.startswith("#"):
            lines.append((number, content))
    return lines


def read_table(path: Path, columns: int, ledger: Ledger, what: str) -> Table:
    """The rows of a text file of numbers in `columns` columns apart by white space.

    A row with another number of columns, with something that is no number, or with a value that is not finite is dropped and
    counted as a `what` line. LogError where no row is left.
    """
    values, lines, rows = [], [], []
    numbered = read_lines(path, ledger)
    for row, (line, text) in enumerate(numbered):
        numbers = parse_numbers(text.split())
        if numbers is None or len(numbers) != columns:
            ledger.drop(f"{what} line that is not {columns} numbers", where=f"{path}:{line}")
            continue
        values.append(numbers)
        lines.append(line)
        rows.append(row)
    table = Table(np.array(values).reshape(-1, columns), np.array(lines, dtype=np.int64), np.array(rows, dtype=np.int64))
    finite = np.asarray(np.isfinite(table.values).all(axis=1))
    table = select(table, finite, f"{what} line with a value that is not finite", path, ledger)
    if not len(table.lines):
        state = f"none of its {len(numbered)} lines is usable" if numbered else "nothing in it"
        raise LogError(f"{state}; a {what} line is {columns} numbers", where=str(path))
    return table


def select(table: Table, keep: Bools, reason: str, path: Path, ledger: Ledger) -> Table:
    """The rows of a table where `keep`; the others are counted for `reason`."""
    if keep.all():
        return table
    count_drops(reason, int((~keep).sum()), (f"{path}:{line}" for line in table.lines[~keep]), ledger)
    return Table(table.values[keep], table.lines[keep], table.rows[keep])


def count_drops(reason: str, count: int, places: Iterable[str], ledger: Ledger) -> None:
    """Count `count` drops for `reason`, naming the first of their places."""
    first = list(islice(places, min(count, _PLACES)))
    for place in first:
        ledger.drop(reason, where=place)
    ledger.drop(reason, count - len(first))


def parse_numbers(fields: list[str]) -> list[float] | None:
    """The fields as numbers, None if one is not; what only Python takes for a number (1_000, other digits) is not one."""
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        return None
    text = "".join(fields)
    return numbers if text.isascii() and "_" not in text else None


def in_order(stamps: Floats, repeats: bool = False) -> Bools:
    """Which of the stamps (N,) go forward in time, (N,): those after every stamp before them.

    What comes after the clock jumped back is left out until it passes the latest stamp: it is not sorted into the past. A
    stamp that alone stands out into the future, so that two or more after it go on from the one before it, is itself left
    out. With `repeats`, a stamp may equal the one before.
    """
    before = np.concatenate([[-np.inf], stamps])[:-1]
    alone = np.zeros(len(stamps), dtype=bool)
    alone[:-2] = (before[:-2] < stamps[1:-1]) & (stamps[1:-1] < stamps[2:]) & (stamps[2:] < stamps[:-2])
    latest = np.concatenate([[-np.inf], np.maximum.accumulate(np.where(alone, -np.inf, stamps))])[:-1]
    return ~alone & ((stamps >= latest) if repeats else (stamps > latest))
