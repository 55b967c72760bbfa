"""Read ROS 1 bags (format 2.0) record by record from the front, so that damage affects only the records that it hits.

The format is documented at https://wiki.ros.org/Bags/Format/2.0. The indexes are used only for the connections and the
expected number of messages.
"""

import io
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from objslam.ros.bag.decompress import CorruptDataError, unpack
from objslam.ros.bag.records import MAX_RECORD, FileReport, Messages, Reading, Wanted, make_connection

MAGIC = b"#ROSBAG V2.0\n"
_OPS = _MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07"
_OP_FIELD = re.compile(rb"\x04\x00\x00\x00op=[\x02\x04\x05\x06\x07]")
_MAX_HEADER = 1 << 16  # The length limit of a record header, bytes. A longer header counts as damage.
_MAX_SEARCHED_HEADER = 512  # The longest header that the search after damage finds, bytes. A larger value slows the search.
_BLOCK = 1 << 20  # The number of bytes that are read at once. With a larger number, reads are fewer and take more memory.
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
_Fields = dict[bytes, bytes]


@dataclass
class _Reading(Reading):
    chunk_at: int = 0  # The byte where the data of the current chunk start.

    def next_chunk(self, at: int) -> None:
        """Report the damage of the current chunk, and start the next chunk at byte `at`."""
        lost = self.chunk_indexed - self.chunk_read
        if self.chunk_indexed and lost > 0 and not self.chunk_problem:
            self.report.damage(f"the chunk at byte {self.chunk_at} lacks messages that its index lists", lost)
        self.end_chunk()
        self.chunk_at = at


def read_bag1(path: Path, report: FileReport, wanted: Wanted) -> Messages:
    """Yield the wanted messages of a bag in file order. The bag may be damaged or unclosed. `report` gets its damage."""
    with path.open("rb", buffering=_BLOCK) as file:
        end = os.fstat(file.fileno()).st_size
        reading = _Reading(report, wanted)
        _read_index(file, end, reading)
        yield from _walk(file, len(MAGIC), end, reading)
        reading.next_chunk(end)


def _walk(stream: BinaryIO, at: int, end: int, reading: _Reading, chunks: bool = True) -> Messages:
    """Yield the wanted messages from byte `at` to byte `end` of a stream. The stream is a file or an unpacked chunk.
    chunks: whether the stream may contain chunks. An unpacked chunk never contains chunks."""
    report = reading.report
    while at < end:
        stream.seek(at)
        record = _read_header(stream, at, end)
        if record is None:
            found = _find_record(stream, at + 1, end)
            where = f"byte {at}" if chunks else f"byte {at} of the unpacked chunk at byte {reading.chunk_at}"
            if found is None:
                report.damage(f"cut off or broken at {where}, the last {end - at} bytes hold no whole record")
                return
            report.damage(f"no records from {where} to byte {found}")
            at = found
            continue
        op, fields, start, size = record
        at = start + size
        if op == _MESSAGE:
            connection = reading.connections.get(_number(fields, b"conn"))
            reading.chunk_read += 1
            if connection is None or size > MAX_RECORD:
                why = "a connection without a description" if connection is None else f"more than {MAX_RECORD >> 20} MiB"
                report.damage(f"messages of {why}", 1)
                continue
            report.messages += 1
            if reading.wanted(connection):
                seconds, nanoseconds = _TIME.unpack(fields.get(b"time", b"").ljust(8, b"\0")[:8])
                yield connection, seconds * 10**9 + nanoseconds, stream.read(size)
        elif op == _CHUNK and chunks:
            reading.next_chunk(start)
            if fields.get(b"compression") == b"none":
                at = start  # The records of an uncompressed chunk are read like records outside of chunks.
                continue
            unpacked, at = _unpack_chunk(stream, fields, start, size, end, reading)
            yield from _walk(io.BytesIO(unpacked), 0, len(unpacked), reading, chunks=False)
        elif op == _CONNECTION:
            _add_connection(fields, stream.read(size), reading)
        elif op == _INDEX:
            reading.chunk_indexed += _number(fields, b"count")


def _unpack_chunk(
    stream: BinaryIO, fields: _Fields, start: int, size: int, end: int, reading: _Reading
) -> tuple[bytes, int]:
    """Return the readable records of a compressed chunk and the byte where the next record starts."""
    method = fields.get(b"compression", b"").decode("ascii", "replace")
    unfinished = size == 0 or start + size > end  # The recorder writes the size only when it closes the chunk.
    after = end if unfinished else start + size
    try:
        if not unfinished and size > MAX_RECORD:
            raise CorruptDataError(f"larger than {MAX_RECORD >> 20} MiB")
        unpacked = unpack(stream.read(min(after - start, MAX_RECORD)), method, cut=unfinished)
        if not unfinished and len(unpacked) != _number(fields, b"size"):
            raise CorruptDataError("its unpacked size is not the stated size")
    except CorruptDataError as damaged:
        reading.chunk_problem = f"the chunk at byte {start} is broken: {damaged}"
        return b"", after
    if unfinished:
        reading.report.damage(f"cut off in the chunk at byte {start}")
    return unpacked, after


def _read_header(stream: BinaryIO, at: int, end: int) -> tuple[bytes, _Fields, int, int] | None:
    """Return the operation, the fields, the data start (byte) and the data size (bytes) of the record at byte `at`.
    Return None if the record is not valid."""
    size = int.from_bytes(stream.read(4), "little")
    if not 0 < size <= _MAX_HEADER:
        return None
    header = stream.read(size + 4)
    if len(header) < size + 4:
        return None
    fields = _parse_fields(header[:size]) or {}
    op = fields.get(b"op")
    start = at + 8 + size
    (data,) = _U32.unpack_from(header, size)
    if op not in _OPS or (start + data > end and op != _CHUNK):
        return None
    return op, fields, start, data


def _parse_fields(header: bytes) -> _Fields | None:
    """Return the values of a header by field name, or None if the header is malformed."""
    fields = {}
    at = 0
    while at < len(header):
        size = int.from_bytes(header[at : at + 4], "little")
        name, sign, value = header[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not sign or at > len(header):
            return None
        fields[name] = value
    return fields


def _number(fields: _Fields, name: bytes) -> int:
    """Return the unsigned number in the header field `name`, or -1 if the field is missing."""
    value = fields.get(name)
    return -1 if value is None else int.from_bytes(value, "little")


def _find_record(stream: BinaryIO, at: int, end: int) -> int | None:
    """Return the byte where the next plausible record header starts, or None if no such header follows."""
    while at < end:
        stream.seek(at)
        block = stream.read(_BLOCK + _MAX_SEARCHED_HEADER)
        for match in _OP_FIELD.finditer(block):
            for start in range(match.start() - 4, max(match.start() - _MAX_SEARCHED_HEADER, -1), -1):
                (size,) = _U32.unpack_from(block, start)
                fits = match.end() - start - 4 <= size <= _MAX_SEARCHED_HEADER and start + 4 + size <= len(block)
                if fits and b"op" in (_parse_fields(block[start + 4 : start + 4 + size]) or {}):
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
    connection, key = make_connection(topic, name, "ros1", definition, "msg"), _number(fields, b"conn")
    # Callers use id() of a connection as a key, so a repeated connection must not replace the first.
    if reading.connections.get(key) != connection:
        reading.connections[key] = connection


def _read_index(file: BinaryIO, end: int, reading: _Reading) -> None:
    """Read the connections and the expected number of messages from the index at the end of a closed bag."""
    file.seek(len(MAGIC))
    record = _read_header(file, len(MAGIC), end)
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
