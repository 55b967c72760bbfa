"""Read MCAP files record by record from the front, so that neither index nor footer is needed.

See https://mcap.dev/spec. The summary is used only for the message count, and for channels whose first description is lost.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from objslam.ros.bag.decompress import CorruptDataError, unpack
from objslam.ros.bag.records import LANGUAGES, MAX_RECORD, FileReport, Messages, Reading, Wanted, make_connection

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _STATISTICS, _DATA_END, _FOOTER = 3, 4, 5, 6, 7, 11, 15, 2
_KNOWN = range(1, 16)  # The operation codes that the format defines.
_PRIVATE = 0x80  # The first operation code that the format reserves for applications.
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_CHUNK_START = re.compile(rb"\x06.{5}\0\0\0.{21}\0\0\0.{4}(\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd).{5}\0\0\0", re.DOTALL)
"""The pattern of the head of a chunk record: length, two timestamps, unpacked size, CRC, compression, packed size. The
pattern finds only chunks of less than 2^40 bytes."""
_BLOCK = 1 << 20  # The number of bytes that are read at once. With a larger number, reads are fewer and take more memory.
_LATEST = 2**63 - 1  # The largest recording time that a signed 64-bit integer holds, ns.


@dataclass
class _Reading(Reading):
    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)  # Name, language and definition by schema id.


def read_mcap(path: Path, report: FileReport, wanted: Wanted) -> Messages:
    """Yield the wanted messages of an MCAP file in file order. `report` gets the damage of the file.

    The file may be damaged or unclosed. A cut-off last chunk is read as far as it can be unpacked. A chunk with a wrong CRC
    is skipped.
    """
    with path.open("rb", buffering=_BLOCK) as file:
        end = os.fstat(file.fileno()).st_size
        reading = _Reading(report, wanted)
        _read_summary(file, end, reading)
        yield from _walk(file, len(MAGIC), end, reading)
        reading.end_chunk()


def _walk(file: BinaryIO, at: int, end: int, reading: _Reading) -> Messages:
    report = reading.report
    while at + _RECORD.size <= end:
        file.seek(at)
        op, size = _RECORD.unpack(file.read(_RECORD.size))
        start = at + _RECORD.size
        if op in (_DATA_END, _FOOTER) and start + size <= end:  # The summary follows.
            return
        known = op in _KNOWN or op >= _PRIVATE
        if not known or start + size > end:
            found = _find_chunk(file, at + 1, end)
            if found is not None:
                report.damage(f"no records from byte {at} to byte {found}")
                at = found
                continue
            if op == _CHUNK:
                reading.end_chunk()
                report.damage(f"cut off in the chunk at byte {at}")
                file.seek(start)
                try:
                    records = _unpack_chunk(file.read(min(end - start, MAX_RECORD)), cut=True)
                    yield from _records(records, reading)
                except CorruptDataError as damaged:
                    report.damage(f"nothing of the last chunk can be read: {damaged}")
                return
            break
        at = start + size
        if op not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX):
            continue
        if size > MAX_RECORD:
            report.damage(f"the record at byte {start} is larger than {MAX_RECORD >> 20} MiB")
        elif op == _CHUNK:
            reading.end_chunk()
            try:
                records = _unpack_chunk(file.read(size))
            except CorruptDataError as damaged:
                reading.chunk_problem = f"the chunk at byte {start} is broken: {damaged}"
                continue
            yield from _records(records, reading)
        elif op == _MESSAGE_INDEX:
            reading.chunk_indexed += max(size - 6, 0) // 16
        else:
            yield from _record(op, file.read(size), reading)
    rest = f", the last {end - at} bytes hold no whole record" if end > at else ""
    report.damage(f"cut off or never closed at byte {at}{rest}")


def _records(data: bytes, reading: _Reading) -> Messages:
    """Yield the wanted messages of an unpacked chunk, up to the last whole record."""
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
            connection = reading.connections.get(channel)
            if connection is None:
                reading.report.damage("messages of a channel without a description", 1)
                continue
            reading.report.messages += 1
            if reading.wanted(connection):
                yield connection, min(stamp, _LATEST), data[start + _MESSAGE_HEAD.size : at]
        else:
            yield from _record(op, data[start:at], reading)


def _record(op: int, data: bytes, reading: _Reading) -> Messages:
    """Store a schema or channel, or yield a wanted message that is outside of all chunks."""
    try:
        if op == _SCHEMA:
            (key,) = _U16.unpack_from(data)
            name, encoding, text = _strings(data, 2, 3)
            reading.schemas[key] = (name, LANGUAGES.get(encoding, ""), text)
        elif op == _CHANNEL:
            key, schema = struct.unpack_from("<HH", data)
            topic, encoding = _strings(data, 4, 2)
            name, language, text = reading.schemas.get(schema, ("", "", ""))
            channel = make_connection(topic, name, encoding, text, language)
            if key not in reading.connections or (name and reading.connections[key] != channel):
                reading.connections[key] = channel
        elif op == _MESSAGE:
            if len(data) < _MESSAGE_HEAD.size:
                raise CorruptDataError("the header of a message is incomplete")
            yield from _records(_RECORD.pack(op, len(data)) + data, reading)
    except (struct.error, CorruptDataError):
        reading.report.damage("a broken schema, channel or message")


def _strings(data: bytes, at: int, count: int) -> Iterator[str]:
    for _ in range(count):
        (size,) = _U32.unpack_from(data, at)
        at += 4
        if at + size > len(data):
            raise CorruptDataError("a text that is longer than its record")
        yield data[at : at + size].decode("utf-8", "replace")
        at += size


def _unpack_chunk(data: bytes, cut: bool = False) -> bytes:
    """Return the unpacked records of a chunk. If `cut` is True, return the part of the records that can be unpacked.
    Raises CorruptDataError if the chunk is broken."""
    try:
        _, _, size, crc = _CHUNK_HEAD.unpack_from(data)
        (method,) = _strings(data, _CHUNK_HEAD.size, 1)
    except struct.error as error:
        raise CorruptDataError("its header is incomplete") from error
    start = _CHUNK_HEAD.size + 4 + len(method.encode()) + 8
    if cut:
        return unpack(data[start:], method, cut=True)
    end = start + int.from_bytes(data[start - 8 : start], "little")
    if end > len(data):
        raise CorruptDataError("its records are longer than the chunk")
    records = unpack(data[start:end], method)
    if len(records) != size:
        raise CorruptDataError("its unpacked size is not the stated size")
    if crc and zlib.crc32(records) != crc:
        raise CorruptDataError("its CRC is wrong")
    return records


def _find_chunk(file: BinaryIO, at: int, end: int) -> int | None:
    """Return the byte where the next whole chunk with consistent sizes starts, or None if no such chunk follows."""
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
    """Read the channels and the expected number of messages from the summary at the end of a closed file."""
    footer = end - len(MAGIC) - 20 - _RECORD.size
    if footer < len(MAGIC):
        return
    file.seek(footer)
    tail = file.read()
    if tail[-len(MAGIC) :] != MAGIC or _RECORD.unpack_from(tail) != (_FOOTER, 20):
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
            list(_record(op, data, reading))
        elif op == _STATISTICS and len(data) >= 8:
            (reading.report.expected,) = _U64.unpack_from(data)
