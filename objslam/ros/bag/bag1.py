"""ROS 1 bags (format 2.0), read record by record from the front: no index is needed, and damage costs only what it hit.

https://wiki.ros.org/Bags/Format/2.0. The indexes are used for what they are good at: to tell what is missing.
"""

from __future__ import annotations

import io
import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from objslam.ros.bag.decompress import CorruptDataError, unpack
from objslam.ros.bag.records import MAX_RECORD, Connection, FileReport, Messages, plain, type_name

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07"
_OPS = {_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION}
_OP_FIELD = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04\x05\x06\x07]")
_MAX_HEADER = 1 << 16  # The longest header of a record, bytes; a longer one is damage.
_MAX_SEARCHED_HEADER = 512  # The longest header that a search after damage finds, bytes; larger: the search takes longer.
_BLOCK = 1 << 20  # The bytes that are read at once; chosen for few reads and little memory.
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
_Fields = dict[bytes, bytes]
_Wanted = Callable[[Connection], bool]


@dataclass
class _Reading:
    """What is known while a file is read: its connections, and how the chunk at hand compares with its index."""

    report: FileReport
    wanted: _Wanted
    connections: dict[int, Connection] = field(default_factory=dict)
    chunk_at: int = 0
    chunk_read: int = 0
    chunk_indexed: int = 0
    chunk_problem: str = ""

    def next_chunk(self, at: int) -> None:
        """Settle the chunk before: its index has come after it, if it came at all."""
        lost = self.chunk_indexed - self.chunk_read if self.chunk_indexed else None
        if self.chunk_problem:
            self.report.damage(self.chunk_problem, lost)
        elif lost is not None and lost > 0:
            self.report.damage(f"the chunk at byte {self.chunk_at} lacks messages that its index lists", lost)
        self.chunk_at, self.chunk_read, self.chunk_indexed, self.chunk_problem = at, 0, 0, ""


def read_bag1(path: Path, report: FileReport, wanted: _Wanted) -> Messages:
    """The messages of the wanted connections of a bag, in the order of the file.

    Also of a bag that was never closed, is cut off or broken in places; `report` says what is missing.
    """
    with path.open("rb", buffering=_BLOCK) as file:
        end = os.fstat(file.fileno()).st_size
        reading = _Reading(report, wanted)
        _read_index(file, end, reading)
        yield from _walk(file, len(MAGIC), end, reading)
        reading.next_chunk(end)


def _walk(stream: BinaryIO, at: int, end: int, reading: _Reading, chunks: bool = True) -> Messages:
    """The messages between two bytes of a file, or of an unpacked chunk, where no chunks can be."""
    report = reading.report
    stream.seek(at)
    while at < end:
        record = _read_header(stream, at, end)
        if record is None:
            found = _find_record(stream, at + 1, end)
            where = f"byte {at}" if chunks else f"byte {at} of the unpacked chunk at byte {reading.chunk_at}"
            if found is None:
                report.damage(f"cut off or broken at {where}, the last {end - at} bytes hold no whole record")
                return
            report.damage(f"no records from {where} to byte {found}")
            at = found
            stream.seek(at)
            continue
        op, fields, start, size = record
        at = start + size
        if op == _MESSAGE:
            connection = reading.connections.get(_number(fields, b"conn"))
            reading.chunk_read += 1
            if connection is None or size > MAX_RECORD:
                why = "a connection of which nothing is known" if connection is None else f"more than {MAX_RECORD >> 20} MiB"
                report.damage(f"messages of {why}", 1)
                stream.seek(at)
                continue
            report.messages += 1
            if reading.wanted(connection):
                seconds, nanoseconds = _TIME.unpack(fields.get(b"time", b"").ljust(8, b"\0")[:8])
                yield connection, seconds * 10**9 + nanoseconds, stream.read(size)
            else:
                stream.seek(at)
        elif op == _CHUNK and chunks:
            reading.next_chunk(start)
            if fields.get(b"compression") == b"none":
                at = start  # the records of the chunk are read as if they lay in the file itself
                continue
            unpacked, at = _unpack_chunk(stream, fields, start, size, end, reading)
            yield from _walk(io.BytesIO(unpacked), 0, len(unpacked), reading, chunks=False)
            stream.seek(at)
        elif op == _CONNECTION:
            _add_connection(fields, stream.read(size), reading)
        elif op == _INDEX:
            reading.chunk_indexed += _number(fields, b"count")
            stream.seek(at)
        else:
            stream.seek(at)


def _unpack_chunk(
    stream: BinaryIO, fields: _Fields, start: int, size: int, end: int, reading: _Reading
) -> tuple[bytes, int]:
    """The records of a compressed chunk, as far as they can be had, and where the next record begins."""
    method = fields.get(b"compression", b"").decode("ascii", "replace")
    unfinished = size == 0 or start + size > end  # the recorder writes the size when it closes the chunk
    after = end if unfinished else start + size
    try:
        if not unfinished and size > MAX_RECORD:
            raise CorruptDataError(f"larger than {MAX_RECORD >> 20} MiB")
        unpacked = unpack(stream.read(min(after - start, MAX_RECORD)), method, cut=unfinished)
        if not unfinished and len(unpacked) != _number(fields, b"size"):
            raise CorruptDataError("unpacks to another size than it says")
    except CorruptDataError as damaged:
        reading.chunk_problem = f"the chunk at byte {start} is broken: {damaged}"
        return b"", after
    if unfinished:
        reading.report.damage(f"cut off in the chunk at byte {start}")
    return unpacked, after


def _read_header(stream: BinaryIO, at: int, end: int) -> tuple[bytes, _Fields, int, int] | None:
    """The operation and fields of the record at a byte, and where its data start and their size; None if there is none."""
    length = stream.read(4)
    if len(length) < 4:
        return None
    (size,) = _U32.unpack(length)
    if not 0 < size <= _MAX_HEADER:
        return None
    header = stream.read(size + 4)
    if len(header) < size + 4:
        return None
    fields = _parse_fields(header[:size])
    op = None if fields is None else fields.get(b"op")
    if fields is None or op not in _OPS:
        return None
    start = at + 8 + size
    (data,) = _U32.unpack_from(header, size)
    if start + data > end and op != _CHUNK:
        return None
    return op, fields, start, data


def _parse_fields(header: bytes) -> _Fields | None:
    fields = {}
    at, end = 0, len(header)
    while at < end:
        if at + 4 > end:
            return None
        (size,) = _U32.unpack_from(header, at)
        at += 4
        name, sign, value = header[at : at + size].partition(b"=")
        at += size
        if not sign or at > end:
            return None
        fields[name] = value
    return fields


def _number(fields: _Fields, name: bytes) -> int:
    """An unsigned number of the header, -1 where it is missing."""
    value = fields.get(name)
    return -1 if value is None else int.from_bytes(value, "little")


def _find_record(stream: BinaryIO, at: int, end: int) -> int | None:
    """The byte where the next thing that looks like a record begins."""
    while at < end:
        stream.seek(at)
        block = stream.read(_BLOCK + _MAX_SEARCHED_HEADER)
        for match in _OP_FIELD.finditer(block):
            for start in range(match.start() - 4, max(match.start() - _MAX_SEARCHED_HEADER, -1), -1):
                (size,) = _U32.unpack_from(block, start)
                if match.end() - start - 4 <= size <= _MAX_SEARCHED_HEADER and start + 4 + size <= len(block):
                    fields = _parse_fields(block[start + 4 : start + 4 + size])
                    if fields is not None and b"op" in fields:
                        return at + start
        at += _BLOCK
    return None


def _add_connection(fields: _Fields, data: bytes, reading: _Reading) -> None:
    details = _parse_fields(data)
    topic = fields.get(b"topic", b"").decode("utf-8", "replace")
    if details is None or not topic:
        reading.report.damage("a connection whose description is broken", 0)
        return
    name, definition = (details.get(key, b"").decode("utf-8", "replace") for key in (b"type", b"message_definition"))
    connection, key = Connection(plain(topic), type_name(name), "ros1", definition), _number(fields, b"conn")
    if reading.connections.get(key) != connection:
        reading.connections[key] = connection


def _read_index(file: BinaryIO, end: int, reading: _Reading) -> None:
    """Connections and the number of messages, from the index that closes a whole bag; nothing where it is missing."""
    at = len(MAGIC)
    file.seek(at)
    record = _read_header(file, at, end)
    if record is None or record[0] != _BAG_HEADER:
        reading.report.damage("no bag header", 0)
        return
    at = _number(record[1], b"index_pos")
    if not len(MAGIC) < at <= end:
        reading.report.damage("cut off before its index" if at > end else "never closed, it has no index")
        return
    expected = 0
    file.seek(at)
    while at < end:
        record = _read_header(file, at, end)
        if record is None or record[0] not in (_CONNECTION, _CHUNK_INFO):
            reading.report.damage(f"its index is broken at byte {at}")
            return
        op, fields, start, size = record
        data = file.read(size)
        at = start + size
        if op == _CONNECTION:
            _add_connection(fields, data, reading)
        else:
            expected += sum(_U32.unpack_from(data, i + 4)[0] for i in range(0, len(data) - 7, 8))
    reading.report.expected = expected
