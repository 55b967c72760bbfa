"""Read text files of a log line by line. Malformed lines are dropped and counted with file and line."""

import gzip
import io
import stat
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.errors import LogError

_IN_ORDER = 0.5
"""The least share of the rows of a file that must be in the order of time. A smaller share is an error. A file that is
sorted in another way has a far smaller share. A larger value also rejects files of a robot whose clock was set back."""
_PLACES = 3
"""The largest number of dropped rows for one reason whose places (file:line) the ledger gets. A larger number gives more
examples."""
_SHOWN = 80  # The largest number of characters of a line that a message shows. A larger number makes the message longer.
_CLOSE = 0.75
"""The least similarity, from 0 to 1, of a misspelt name to the right name. A larger number finds fewer misspelt names. A
smaller number takes names of other programs for misspelt names."""
_MAX_UNPACKED = 1 << 30  # The largest size of an unpacked file, bytes. A day of poses at 200 Hz is smaller.


@dataclass(frozen=True)
class Table:
    """The valid rows of a text file of numbers."""

    values: Floats  # (N, C), finite.
    lines: Ints  # (N,) line numbers, from 1.
    rows: Ints  # (N,) row numbers, from 0. Dropped rows also have a number, so rows of several files match by number.


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert each OSError of the block to LogError. It names the failing file, or `path` if the error has no file name."""
    try:
        yield
    except OSError as error:
        where = error.filename if isinstance(error.filename, str) else str(path)
        raise LogError(f"cannot be read: {error.strerror or error}", where=where) from error


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file. A file with the suffix .gz is unpacked. Raises LogError if this fails."""
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
    """Return the number (from 1) and the stripped text of each line of a UTF-8 file, without empty lines and '#' comments.

    Lines that are not UTF-8 are dropped and counted. Raises LogError if the file is unreadable.
    """
    return split_lines(read_bytes(path), str(path), ledger)


def split_lines(data: bytes, place: str, ledger: Ledger) -> list[tuple[int, str]]:
    """Return the lines in the bytes of a file, as `read_lines` does. place: the file name in the ledger."""
    damaged = False
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        damaged = True
        text = data.decode("utf-8-sig", errors="replace")
    numbered = enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
    lines = [(number, content) for number, line in numbered if (content := line.strip())]
    if damaged:
        for number, content in lines:
            if "\ufffd" in content:
                ledger.drop("line that is not UTF-8 text", where=f"{place}:{number}")
        lines = [line for line in lines if "\ufffd" not in line[1]]
    return [line for line in lines if line[1][0] != "#"]


def read_table(path: Path, columns: int, ledger: Ledger, what: str) -> Table:
    """Return the table of a text file. Each line has `columns` numbers with white space between them. See `to_table`."""
    return to_table(read_lines(path, ledger), path, columns, ledger, what)


def to_table(
    numbered: Sequence[tuple[int, str]], path: Path, columns: int, ledger: Ledger, what: str, form: str = ""
) -> Table:
    """Return the table of lines from `read_lines` that have `columns` numbers each. Raises LogError if no line is valid.

    Lines with another number of columns or a value that is not finite are dropped and counted. what: the name of a line in
    messages, such as "pose". form: what a line contains, for the error. If `form` is "", the error states `columns` numbers.
    """
    table = _clean_table(numbered, columns)
    if table is None:
        values, places = [], []
        for row, (line, text) in enumerate(numbered):
            numbers = parse_numbers(text.split())
            if numbers is None or len(numbers) != columns:
                ledger.drop(f"{what} line that is not {columns} numbers", where=f"{path}:{line}")
                continue
            values.append(numbers)
            places.append((line, row))
        table = Table(np.array(values).reshape(-1, columns), *np.array(places, dtype=np.int64).reshape(-1, 2).T)
    finite = np.asarray(np.isfinite(table.values).all(axis=1))
    table = select(table, finite, f"{what} line with a value that is not finite", path, ledger)
    if not len(table.lines):
        state = f"none of its {len(numbered)} lines is usable" if numbered else "nothing in it"
        state += f", the first is {numbered[0][1].strip()[:_SHOWN]!r}" if numbered else ""
        raise LogError(f"{state}; a {what} line is {form or f'{columns} numbers'}", where=str(path))
    return table


def _clean_table(numbered: Sequence[tuple[int, str]], columns: int) -> Table | None:
    """Return the table if all lines have `columns` numbers, else None. This is three times as fast as a loop over lines."""
    lines = [text for _, text in numbered]
    whole = "".join(lines)
    if not lines or "_" in whole or not whole.isascii():
        return None
    try:
        values = np.loadtxt(lines, comments=None, ndmin=2)
    except ValueError:
        return None
    if values.shape != (len(lines), columns):
        return None
    return Table(values, np.array([line for line, _ in numbered], dtype=np.int64), np.arange(len(lines)))


def select(table: Table, keep: Bools, reason: str, path: Path, ledger: Ledger) -> Table:
    """Return the rows of a table where `keep` (N,) is True. The ledger counts the other rows as drops under `reason`."""
    count_drops(reason, int((~keep).sum()), (f"{path}:{line}" for line in table.lines[~keep]), ledger)
    return Table(table.values[keep], table.lines[keep], table.rows[keep])


def count_drops(reason: str, count: int, places: Iterable[str], ledger: Ledger) -> None:
    """Add `count` drops under `reason` to the ledger, with the first few places. places: file:line of each drop."""
    first = list(islice(places, min(count, _PLACES)))
    for place in first:
        ledger.drop(reason, where=place)
    ledger.drop(reason, count - len(first))


def drop_rows(reason: str, bad: Bools, places: Sequence[str], ledger: Ledger) -> None:
    """Count the rows where `bad` (N,) is True as drops under `reason`. places: the N places (file:line) of the rows."""
    rows = np.flatnonzero(bad).tolist()
    count_drops(reason, len(rows), (places[i] for i in rows), ledger)


def parse_numbers(fields: list[str]) -> list[float] | None:
    """Return the fields as numbers, or None if a field is invalid. Forms such as 1_000 or non-ASCII digits are invalid."""
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        return None
    text = "".join(fields)
    return numbers if text.isascii() and "_" not in text else None


def require_order(forward: Bools, path: Path) -> None:
    """Raise LogError if most rows of a file are out of time order. forward: (N,) the mask of the rows in order."""
    if forward.mean() < _IN_ORDER:
        wrong = f"{int((~forward).sum())} of its {len(forward)} stamps repeat or go back"
        raise LogError(wrong, where=str(path), hint="sort the lines by their stamps")


def in_order(stamps: Floats, repeats: bool = False) -> Bools:
    """Return the mask (N,) of the timestamps (N,) that are later than all previous timestamps.

    If the clock jumps back, timestamps are rejected until they are later than the latest one before the jump. A single
    timestamp too far in the future is an outlier: the next two timestamps are earlier than the outlier, but later than the
    timestamp before the outlier. Then only the outlier is rejected, and the timestamps after it stay. With `repeats`, a
    timestamp may equal the latest one.
    """
    before = np.concatenate([[-np.inf], stamps])[:-1]
    alone = np.zeros(len(stamps), dtype=bool)
    alone[:-2] = (before[:-2] < stamps[1:-1]) & (stamps[1:-1] < stamps[2:]) & (stamps[2:] < stamps[:-2])
    latest = np.concatenate([[-np.inf], np.maximum.accumulate(np.where(alone, -np.inf, stamps))])[:-1]
    return ~alone & ((stamps >= latest) if repeats else (stamps > latest))


def misspelt(given: Iterable[str], names: Collection[str]) -> dict[str, str]:
    """Return the right name for each given name that is probably misspelt.

    given: names of files or keys. A misspelt one, for example localisation.txt, would not be read. names: all names that are
    read. A right name that is itself in `given` is not returned for another name.
    """
    given = list(dict.fromkeys(given))
    absent = [name for name in names if name not in given]
    meant = {name: get_close_matches(name, absent, 1, _CLOSE) for name in given if name not in names}
    return {name: close[0] for name, close in meant.items() if close}
