"""MCAP files, read record by record from the front: no index and no footer is needed, and each chunk is checked by its CRC.

https://mcap.dev/spec. The summary at the end is used for what it is good at: channels whose first description is lost, and
the number of messages that there should be.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from objslam.ros.bag.decompress import CorruptDataError, unpack
from objslam.ros.bag.records import LANGUAGES, MAX_RECORD, Connection, FileReport, Messages, plain, type_name

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _STATISTICS, _DATA_END, _FOOTER = 3, 4, 5, 6, 7, 11, 15, 2
_KNOWN = range(1, 16)  # The operations that the format defines.
_PRIVATE = 0x80  # The first operation that the format leaves to applications.
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_CHUNK_START = re.compile(rb"\x06.{5}\0\0\0.{21}\0\0\0.{4}(\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd).{5}\0\0\0", re.DOTALL)
"""A chunk record: its length, two times, the size unpacked (sizes below 2^40), CRC, compression, the size packed."""

_BLOCK = 1 << 20  # The bytes that are read at once; chosen for few reads and little memory.
_LATEST = 2**63 - 1  # The latest time of recording, ns, that 64 bits with a sign hold.
_Wanted = Callable[[Connection], bool]


@dataclass
class _Reading:
    """What is known while a file is read: schemas, channels, and how the chunk at hand compares with its index."""

    report: FileReport
    wanted: _Wanted
    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    channels: dict[int, Connection] = field(default_factory=dict)
    chunk_read: int = 0
    chunk_indexed: int = 0
    chunk_problem: str = ""

    def next_chunk(self) -> None:
        """Settle the chunk before: its index has come after it, if it came at all."""
        if self.chunk_problem:
            lost = self.chunk_indexed - self.chunk_read if self.chunk_indexed else None
            self.report.damage(self.chunk_problem, lost)
        self.chunk_read, self.chunk_indexed, self.chunk_problem = 0, 0, ""


def read_mcap(path: Path, report: FileReport, wanted: _Wanted) -> Messages:
    """The messages of the wanted channels of an MCAP file, in the order of the file.

    Also of a file that was never closed, is cut off or broken in places; of the last chunk of a file cut off, what can be
    unpacked is read. A chunk that fails its CRC is left out. `report` says what is missing.
    """
    with path.open("rb", buffering=_BLOCK) as file:
        end = os.fstat(file.fileno()).st_size
        reading = _Reading(report, wanted)
        _read_summary(file, end, reading)
        yield from _walk(file, len(MAGIC), end, reading)
        reading.next_chunk()


def _walk(file: BinaryIO, at: int, end: int, reading: _Reading) -> Messages:
    report = reading.report
    closed = False
    file.seek(at)
    while at + _RECORD.size <= end:
        op, size = _RECORD.unpack(file.read(_RECORD.size))
        start = at + _RECORD.size
        if op in (_DATA_END, _FOOTER) and start + size <= end:  # what follows is the summary
            closed = True
            break
        known = op in _KNOWN or op >= _PRIVATE
        if not known or start + size > end:
            found = _find_chunk(file, at + 1, end)
            if found is not None:
                report.damage(f"no records from byte {at} to byte {found}")
                at = found
                file.seek(at)
                continue
            if op == _CHUNK:
                reading.next_chunk()
                report.damage(f"cut off in the chunk at byte {at}")
                file.seek(start)
                yield from _cut_chunk(file.read(min(end - start, MAX_RECORD)), reading)
                return
            break
        at = start + size
        if op in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX):
            if size > MAX_RECORD:
                report.damage(f"the record at byte {start} is larger than {MAX_RECORD >> 20} MiB")
                file.seek(at)
                continue
            data = file.read(size)
            if op == _CHUNK:
                reading.next_chunk()
                try:
                    records = _unpack_chunk(data)
                except CorruptDataError as damaged:
                    reading.chunk_problem = f"the chunk at byte {start} is broken: {damaged}"
                    continue
                yield from _records(records, reading)
            elif op == _MESSAGE_INDEX:
                reading.chunk_indexed += max(size - 6, 0) // 16
            else:
                yield from _record(op, data, reading)
        else:
            file.seek(at)
    if not closed:
        rest = f", the last {end - at} bytes hold no whole record" if end > at else ""
        report.damage(f"cut off or never closed at byte {at}{rest}")


def _records(data: bytes, reading: _Reading) -> Messages:
    """The messages of an unpacked chunk; what follows the last whole record is left."""
    at, end = 0, len(data)
    while at + _RECORD.size <= end:
        op, size = _RECORD.unpack_from(data, at)
        start = at + _RECORD.size
        at = start + size
        if at > end:
            return
        if op == _MESSAGE and size >= _MESSAGE_HEAD.size:
            reading.chunk_read += 1
            channel, _, stamp, _ = _MESSAGE_HEAD.unpack_from(data, start)
            connection = reading.channels.get(channel)
            if connection is None:
                reading.report.damage("messages of a channel of which nothing is known", 1)
                continue
            reading.report.messages += 1
            if reading.wanted(connection):
                yield connection, min(stamp, _LATEST), data[start + _MESSAGE_HEAD.size : at]
        else:
            yield from _record(op, data[start:at], reading)


def _record(op: int, data: bytes, reading: _Reading) -> Messages:
    """A schema or channel is remembered; a message outside of any chunk is passed on."""
    try:
        if op == _SCHEMA:
            (key,) = _U16.unpack_from(data)
            name, encoding, text = _strings(data, 2, 3)
            reading.schemas[key] = (name, LANGUAGES.get(encoding, ""), text)
        elif op == _CHANNEL:
            key, schema = struct.unpack_from("<HH", data)
            topic, encoding = _strings(data, 4, 2)
            name, language, text = reading.schemas.get(schema, ("", "", ""))
            channel = Connection(plain(topic), type_name(name), encoding, text if language else "", language)
            if key not in reading.channels or (name and reading.channels[key] != channel):
                reading.channels[key] = channel
        elif op == _MESSAGE:
            if len(data) < _MESSAGE_HEAD.size:
                raise CorruptDataError("a message without its head")
            yield from _records(_RECORD.pack(op, len(data)) + data, reading)
    except (struct.error, CorruptDataError):
        reading.report.damage("a schema, channel or message that is broken")


def _strings(data: bytes, at: int, count: int) -> Iterator[str]:
    for _ in range(count):
        (size,) = _U32.unpack_from(data, at)
        at += 4
        if at + size > len(data):
            raise CorruptDataError("a text that is longer than its record")
        yield data[at : at + size].decode("utf-8", "replace")
        at += size


def _chunk_parts(data: bytes) -> tuple[int, int, str, int]:
    """Size unpacked, CRC and compression of a chunk, and where its records start."""
    try:
        _, _, size, crc = _CHUNK_HEAD.unpack_from(data)
        (method,) = _strings(data, _CHUNK_HEAD.size, 1)
        return size, crc, method, _CHUNK_HEAD.size + 4 + len(method.encode()) + 8
    except struct.error as error:
        raise CorruptDataError("it has no head") from error


def _unpack_chunk(data: bytes) -> bytes:
    size, crc, method, start = _chunk_parts(data)
    if start > len(data) or start + _U64.unpack_from(data, start - 8)[0] > len(data):
        raise CorruptDataError("its records are longer than it is")
    records = unpack(data[start : start + _U64.unpack_from(data, start - 8)[0]], method)
    if len(records) != size:
        raise CorruptDataError("it unpacks to another size than it says")
    if crc and zlib.crc32(records) != crc:
        raise CorruptDataError("it fails its CRC")
    return records


def _cut_chunk(data: bytes, reading: _Reading) -> Messages:
    try:
        _, _, method, start = _chunk_parts(data)
        records = unpack(data[start:], method, cut=True)
    except CorruptDataError as damaged:
        reading.report.damage(f"nothing of the last chunk can be read: {damaged}")
        return
    yield from _records(records, reading)


def _find_chunk(file: BinaryIO, at: int, end: int) -> int | None:
    """The byte where the next chunk begins, whole and with sizes that agree."""
    while at < end:
        file.seek(at)
        block = file.read(_BLOCK + 64)
        start = -1
        while match := _CHUNK_START.search(block, start + 1):
            start = match.start()
            (size,) = _U64.unpack_from(block, start + 1)
            (packed,) = _U64.unpack_from(block, match.end() - 8)
            if size == packed + match.end() - start - _RECORD.size and at + start + size <= end:
                return at + start
        at += _BLOCK
    return None


def _read_summary(file: BinaryIO, end: int, reading: _Reading) -> None:
    """Channels and the number of messages, from the summary that closes a whole file; nothing where it is missing."""
    footer = end - len(MAGIC) - 20 - _RECORD.size
    if footer < len(MAGIC):
        return
    file.seek(footer)
    tail = file.read()
    op, size = _RECORD.unpack_from(tail)
    if tail[-len(MAGIC) :] != MAGIC or (op, size) != (_FOOTER, 20):
        return
    (at,) = _U64.unpack_from(tail, _RECORD.size)
    if not len(MAGIC) <= at < footer or footer - at > MAX_RECORD:
        return
    file.seek(at)
    summary = file.read(footer - at)
    at = 0
    while at + _RECORD.size <= len(summary):
        op, size = _RECORD.unpack_from(summary, at)
        data = summary[at + _RECORD.size : at + _RECORD.size + size]
        at += _RECORD.size + size
        if op in (_SCHEMA, _CHANNEL):
            for _ in _record(op, data, reading):
                pass
        elif op == _STATISTICS and len(data) >= 8:
            (reading.report.expected,) = _U64.unpack_from(data)
