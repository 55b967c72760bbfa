"""Find the rows of a damaged SQLite file page by page. The rows of a leaf page survive the loss of the tree above it.

The file format is described in https://www.sqlite.org/fileformat2.html. The sections used are 1.3 (header), 1.6 (b-tree
pages, cells, overflow) and 2.1 (records).
"""

import mmap
import struct
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from objslam.ros.bag.records import MAX_RECORD

Row = tuple[int, int, int, bytes]  # Each row is a tuple of rowid, topic id, recording time (ns) and message.
_LEAF = 13  # The type byte of a table leaf page.
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}  # The size of an integer by its serial type, bytes.
_MAX_COLUMNS = 32  # The largest number of columns in a table of messages. A cell with more columns is not a message.


class _CellError(ValueError):
    """The error for a cell that is incomplete, or that is not a row of the table of messages."""


def missing_pages(path: Path) -> tuple[int, int]:
    """Return the number of whole pages in a file, and the number of missing pages.

    If the header is incomplete, both are 0. If the header is out of date, the number of missing pages is 0.
    """
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) < 100:
        return 0, 0
    changes, pages, valid_for = (struct.unpack_from(">I", header, at)[0] for at in (24, 28, 92))
    there = path.stat().st_size // _page_size(header)
    return there, max(pages - there, 0) if changes == valid_for else 0


def rows_of_pages(path: Path, columns: tuple[int, int, int], topics: frozenset[int], after: int) -> Iterator[Row]:
    """Yield the whole rows on all leaf pages of a file in rowid order. Only rows with a rowid above `after` are yielded.

    columns: the column indices of topic id, time and message. A leaf page does not name its table, so a row counts as a
    message if these columns have valid values and the topic id is in `topics`.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = _page_size(data[:100])
        rowids, places = array("q"), array("q")
        for start in range(size, len(data), size):
            if data[start] != _LEAF or start + 8 > len(data):
                continue
            (cells,) = struct.unpack_from(">H", data, start + 3)
            for at in range(start + 8, min(start + 8 + 2 * cells, start + size - 1, len(data) - 1), 2):
                place = start + int.from_bytes(data[at : at + 2], "big")
                try:
                    rowid = _varint(data, _varint(data, place)[1])[0]
                    if rowid > after:
                        _read_row(data, place, size, columns, topics, whole=False)
                        rowids.append(rowid)
                        places.append(place)
                except (_CellError, IndexError, OverflowError):
                    continue
        keys, first = np.unique(np.frombuffer(rowids, dtype=np.int64), return_index=True)
        for rowid, place in zip(keys.tolist(), np.frombuffer(places, dtype=np.int64)[first].tolist(), strict=True):
            try:
                yield (rowid, *_read_row(data, place, size, columns, topics, whole=True))
            except (_CellError, IndexError):
                continue


def _page_size(header: bytes) -> int:
    (size,) = struct.unpack_from(">H", header, 16)
    return 65536 if size == 1 else max(int(size), 512)


def _varint(data: mmap.mmap, at: int) -> tuple[int, int]:
    """Return the variable-length integer at byte `at`, and the byte after it."""
    value = 0
    for i in range(8):
        byte = data[at + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    value = value << 8 | data[at + 8]
    return value - (1 << 64) if value >> 63 else value, at + 9


def _read_row(
    data: mmap.mmap, at: int, page: int, columns: tuple[int, int, int], topics: frozenset[int], whole: bool
) -> tuple[int, int, bytes]:
    """Return the topic id, the time (ns) and the message of the cell at byte `at` of the file.

    page: the page size, bytes. whole: whether to read the message. If False, the message is empty. Raises _CellError if the
    cell is incomplete, or if it is not a row of the table of messages.
    """
    size, at = _varint(data, at)
    _, at = _varint(data, at)  # The rowid.
    usable = page - data[20]
    local = size  # The number of payload bytes in the cell itself. The rest is on overflow pages.
    if size > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    if not 4 <= size <= MAX_RECORD or at + local > len(data):
        raise _CellError
    head, start = _varint(data, at)
    end = at + head
    if not 2 <= head <= min(local, 9 * _MAX_COLUMNS):
        raise _CellError
    kinds = []
    while start < end:
        kind, start = _varint(data, start)
        kinds.append(kind)
    if max(columns) >= len(kinds):
        raise _CellError
    sizes = [(kind - 12) // 2 if kind >= 12 else 8 if kind == 7 else _INTEGERS.get(kind, 0) for kind in kinds]
    offsets = np.cumsum([head, *sizes]).tolist()
    if offsets[-1] != size:
        raise _CellError
    topic, stamp = (_integer(data, kinds[c], at + offsets[c], at + local) for c in columns[:2])
    kind = kinds[columns[2]]
    if topic not in topics or kind < 12 or kind % 2:
        raise _CellError
    if not whole:
        return topic, stamp, b""
    payload = data[at : at + local] if local == size else _with_overflow(data, at, local, size, page, usable)
    return topic, stamp, payload[offsets[columns[2]] : offsets[columns[2] + 1]]


def _integer(data: mmap.mmap, kind: int, at: int, end: int) -> int:
    if kind in (8, 9):
        return kind - 8
    size = _INTEGERS.get(kind)
    if size is None or at + size > end:
        raise _CellError
    return int.from_bytes(data[at : at + size], "big", signed=True)


def _with_overflow(data: mmap.mmap, at: int, local: int, size: int, page: int, usable: int) -> bytes:
    parts = [data[at : at + local]]
    rest, link = size - local, at + local
    while rest > 0:
        start = (int.from_bytes(data[link : link + 4], "big") - 1) * page
        size = min(rest, usable - 4)
        part = data[start + 4 : start + 4 + size] if start > 0 else b""
        if len(part) < size:
            raise _CellError
        parts.append(part)
        rest -= size
        link = start
    return b"".join(parts)
