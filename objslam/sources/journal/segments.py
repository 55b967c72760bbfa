"""The segments of a journal. A long journal is split into several files, and all but the last are compressed with zstd.

The last segment has the name of the journal. The earlier segments are in the same folder, with the names
journal-IDENTITY.NUMBER.objslam.zst. IDENTITY is in the header of the last segment. A renamed journal therefore keeps its
earlier segments, whose names do not change.
"""

import fcntl
import hashlib
import io
import os
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import zstandard

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.io.folders import remove_leftovers, temporary_name
from objslam.sources.journal.record_format import NAME, Header, pack_header, read_header, records

_PACKED = ".zst"
_LEVEL = 3  # The zstd level. A larger level makes smaller files and takes more time.
_WINDOW = 1 << 27  # The largest memory to unpack a segment, bytes. With a larger value, a damaged file can take more memory.
_CHUNK = 1 << 20  # The number of bytes of one read. A larger number makes fewer reads.


@dataclass(frozen=True)
class Segment:
    """A file of a journal. number: 1 for the first file. header: None if the header is damaged or the file is missing."""

    path: Path
    number: int
    header: Header | None

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """Yield a stream of the uncompressed file, at the first byte after the header, as `records` needs it."""
        with _uncompressed(self.path) as stream:
            read_header(stream)
            yield stream


def journal_file(path: Path) -> Path:
    """Return the file of a journal. path: this file, or the folder that contains it."""
    return path / NAME if path.is_dir() else path


def is_journal(path: Path) -> bool:
    """Return whether a path is a journal or a folder with a journal."""
    file = journal_file(path)
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return read_header(stream) is not None


def holds_messages(file: Path, header: Header | None) -> bool:
    """Return whether a journal has messages. file: its last segment. header: the header of `file`, None if it is damaged."""
    return header is not None and (header.number > 1 or file.stat().st_size > header.size)


def segments(path: Path) -> list[Segment]:
    """Return the segments of a journal in order, including missing ones. Raises LogError if the path is not a journal."""
    file = journal_file(path)
    last = _header(file) if file.is_file() else None
    if last is None:
        raise LogError("this is not a journal", where=str(path))
    earlier = [_existing(sealed(file, last.identity, number)) for number in range(1, last.number)]
    found = [Segment(one, number, _header(one)) for number, one in enumerate(earlier, 1)]
    return [*found, Segment(file, last.number, last)]


def contents(path: Path, ledger: Ledger) -> Iterator[tuple[str, bytes]]:
    """Yield the place (FILE:BYTE) and the content of each undamaged record of a journal.

    The ledger counts damaged and missing parts. Raises LogError if the path is not a journal.
    """
    found = segments(path)
    for segment in found:
        if segment.header is None:
            reason = "damaged" if segment.path.exists() else "missing"
            ledger.drop(f"segment of the journal that is {reason}", where=str(segment.path))
            continue
        end = segment.header.size
        with segment.open() as stream:
            for record in records(stream, segment.header):
                if record.start > end:
                    ledger.drop("damaged record of the journal", where=f"{segment.path}:{end}")
                end = record.end
                yield f"{segment.path}:{record.start}", record.content
            while stream.read(_CHUNK):
                pass
            rest = stream.tell() - end
        if rest > 0:
            ledger.drop("torn record at the end of the journal", where=f"{segment.path}, {rest} bytes")


def sealed(file: Path, identity: bytes, number: int) -> Path:
    """Return the path of segment `number` after it is sealed and before it is compressed. file: the last segment."""
    return file.with_name(f"journal-{identity.hex()}.{number:06d}.objslam")


def identity_of(file: Path, header: Header) -> bytes:
    """Return the identity of a journal, 8 bytes. In format 1, it is a hash of the first 4096 bytes of the file."""
    if header.version > 1:
        return header.identity
    with file.open("rb") as stream:
        return hashlib.sha256(stream.read(4096)).digest()[:8]


def seal(file: Path, identity: bytes, number: int, fresh: Path) -> Path:
    """Give the full segment `file` the name of an earlier segment, then rename `fresh` to `file`. Return the new name.

    A process that is killed between the two steps leaves the full segment under both names. In this case nothing is lost,
    and the next call does both steps. Raises OSError if a file cannot be renamed.
    """
    full = sealed(file, identity, number)
    full.unlink(missing_ok=True)  # A killed process may have left this file. All its content is in `file`.
    try:
        full.hardlink_to(file)
    except OSError:  # The file system has no links.
        shutil.copyfile(file, full)
    fresh.replace(file)
    return full


def new_file(file: Path, identity: bytes, number: int) -> tuple[Path, int]:
    """Make the file of segment `number` under a temporary name beside the journal `file`.

    Return the path of the new file and its locked file descriptor. Raises OSError if the file cannot be written.
    """
    fresh = file.with_name(temporary_name(file))
    handle = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.write(handle, pack_header(identity, number))
        os.fsync(handle)
    except OSError:
        os.close(handle)
        fresh.unlink(missing_ok=True)
        raise
    return fresh, handle


def compress(full: Path) -> Path:
    """Compress the file of a segment, and delete the uncompressed file. Return the path of the compressed file.

    Raises OSError for a disk error, or if the compressed file does not have the same content.
    """
    packed = full.with_name(full.name + _PACKED)
    temporary = packed.with_name(temporary_name(packed))
    remove_leftovers(packed)
    try:
        with full.open("rb") as source, temporary.open("wb") as target:
            size = full.stat().st_size
            zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True).copy_stream(source, target, size=size)
            target.flush()
            os.fsync(target.fileno())
        if _sum(full) != _sum(temporary, packed=True):
            raise OSError(0, "the compressed segment does not read back as it was", str(packed))
        temporary.replace(packed)
    finally:
        temporary.unlink(missing_ok=True)
    full.unlink()
    return packed


def uncompressed_segments(file: Path, identity: bytes, number: int) -> list[Path]:
    """Return the uncompressed files of the segments before `number`. They are new, or left by a session that was killed."""
    return [full for n in range(1, number) if (full := sealed(file, identity, n)).exists()]


def _existing(full: Path) -> Path:
    packed = full.with_name(full.name + _PACKED)
    return full if full.exists() and not packed.exists() else packed


def _header(path: Path) -> Header | None:
    with suppress(FileNotFoundError), _uncompressed(path) as stream:
        return read_header(stream)
    return None


@contextmanager
def _uncompressed(path: Path, packed: bool = False) -> Iterator[BinaryIO]:
    with path.open("rb") as stream:
        if packed or path.suffix == _PACKED:
            yield cast(BinaryIO, _Unpacked(stream))
        else:
            yield stream


class _Unpacked(io.RawIOBase):
    """A stream of the uncompressed bytes of a zstd stream, up to its first damaged part."""

    def __init__(self, stream: BinaryIO) -> None:
        reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        self._inner = reader.stream_reader(stream, read_size=_CHUNK, closefd=False)
        self._read = 0

    def read(self, size: int = -1) -> bytes:
        try:
            data = self._inner.read(size)
        except zstandard.ZstdError:
            return b""
        self._read += len(data)
        return data

    def tell(self) -> int:
        return self._read


def _sum(path: Path, packed: bool = False) -> tuple[int, int]:
    """Return the length and the CRC-32 of the uncompressed bytes of a file."""
    length = checksum = 0
    with _uncompressed(path, packed) as stream:
        while chunk := stream.read(_CHUNK):
            length, checksum = length + len(chunk), zlib.crc32(chunk, checksum)
    return length, checksum
