"""The format of a journal file. The file is a header and records. Each record has its own checksum.

New journals have format 2. Its header has four parts: `OBJSLAM2`, 8 bytes that identify the journal, the number of this
segment from 1 on, and a CRC-32 of these three parts. A record is a mark, the length of its content, a CRC-32 of length and
content, and the content. By the mark, a reader finds the next record after a damaged one. Existing files in format 1 are
read, and records are appended to them. Their header is `OBJSLAM1`. Their records have no mark, and the CRC-32 covers only
the content. All numbers are little endian and have 4 bytes.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

NAME = "journal.objslam"
"""The usual file name of a journal."""
MAGICS = {1: b"OBJSLAM1", 2: b"OBJSLAM2"}
"""The first bytes of a journal file, by format."""
LONGEST = 1 << 26
"""The largest length of the content of a record, bytes. A record that states a greater length counts as damaged."""
_HEADER = struct.Struct("<8s8sII")
_MARK = b"\xf5REC"
_HEADS = {1: struct.Struct("<II"), 2: struct.Struct("<4sII")}
_CHUNK = 1 << 18  # The number of bytes of one read. A larger number makes fewer reads.
_MOST_WASTED = 1 << 30  # The most bytes of damaged records that are checked. With more, a damaged file takes longer.


@dataclass(frozen=True)
class Header:
    """The header of a journal file. version: the format, 1 or 2. size: the length of the header, bytes.

    identity: 8 bytes that are the same in all segments of a journal. number: the number of the segment, from 1 on.
    """

    version: int
    size: int
    identity: bytes = bytes(8)
    number: int = 1


@dataclass(frozen=True)
class Record:
    """A record. start: the place of its first byte in the uncompressed file. end: the place after its last byte."""

    start: int
    end: int
    content: bytes


def pack_header(identity: bytes, number: int) -> bytes:
    """Return the bytes of the header of segment `number` in format 2. identity: the 8 bytes that identify the journal."""
    first = _HEADER.pack(MAGICS[2], identity, number, 0)[:-4]
    return first + zlib.crc32(first).to_bytes(4, "little")


def pack_record(version: int, content: bytes) -> bytes:
    """Return the bytes of a record with this content, in the format `version`."""
    if version == 1:
        return _HEADS[1].pack(len(content), zlib.crc32(content)) + content
    return _HEADS[2].pack(_MARK, len(content), _checksum(content)) + content


def read_header(stream: BinaryIO) -> Header | None:
    """Return the header of a journal file. Return None if the file is no journal, or its header is damaged or incomplete."""
    magic = stream.read(len(MAGICS[1]))
    if magic == MAGICS[1]:
        return Header(1, len(magic))
    data = magic + stream.read(_HEADER.size - len(magic))
    if magic != MAGICS[2] or len(data) < _HEADER.size:
        return None
    _, identity, number, checksum = _HEADER.unpack(data)
    return Header(2, _HEADER.size, identity, number) if zlib.crc32(data[:-4]) == checksum and number > 0 else None


def is_cut_header(data: bytes) -> bool:
    """Return whether `data` is an incomplete header or empty. data: the whole content of a file, or its first 64 bytes."""
    return len(data) < _HEADER.size and any((data + magic[len(data) :]).startswith(magic) for magic in MAGICS.values())


def records(stream: BinaryIO, header: Header) -> Iterator[Record]:
    """Yield the undamaged records after the header. stream: the file, at the first byte after the header.

    If the `start` of a record is not the `end` of the previous record, the bytes between are damaged. In format 1, the
    records after a damaged one cannot be found. The stream may be one that cannot seek.
    """
    head, buffer, base, at, wasted = _HEADS[header.version], bytearray(), header.size, 0, 0

    def has(count: int) -> bool:
        while len(buffer) - at < count and (chunk := stream.read(max(_CHUNK, count - (len(buffer) - at)))):
            buffer.extend(chunk)
        return len(buffer) - at >= count

    while wasted < _MOST_WASTED:
        if at > _CHUNK:
            del buffer[:at]
            base, at = base + at, 0
        if not has(head.size):
            return
        *mark, length, checksum = head.unpack_from(buffer, at)
        if length <= LONGEST and mark in ([], [_MARK]) and has(head.size + length):
            content = bytes(buffer[at + head.size : at + head.size + length])
            if (zlib.crc32(content) if header.version == 1 else _checksum(content)) == checksum:
                yield Record(base + at, base + at + head.size + length, content)
                at += head.size + length
                continue
            wasted += length
        if header.version == 1:
            return
        at += 1
        while (found := buffer.find(_MARK, at)) < 0:
            at = max(at, len(buffer) - len(_MARK) + 1)
            if not has(len(buffer) - at + 1):
                return
            if at > _CHUNK:
                del buffer[:at]
                base, at = base + at, 0
        at = found


def _checksum(content: bytes) -> int:
    return zlib.crc32(content, zlib.crc32(len(content).to_bytes(4, "little")))
