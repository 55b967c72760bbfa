"""Unpack compressed data up to a size limit, and recover the readable part of data that are cut off."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from objslam.ros.bag.records import MAX_RECORD

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # The first bytes of zstd data.
_PIECE = 1 << 22  # The largest piece that is unpacked at once, bytes. A larger piece takes more memory.


class CorruptDataError(ValueError):
    """The error for data that cannot be unpacked. Its message gives the reason."""


def unpack(data: bytes, method: str, *, cut: bool = False) -> bytes:
    """Return the unpacked data. method: "bz2", "lz4" (frame format), "zstd", or "" or "none" for data that are not packed.

    Raises CorruptDataError if the method is unknown, the unpacked size is above `MAX_RECORD`, or the data are broken. If
    `cut` is True, broken data raise no error, and the part before the damage is returned.
    """
    if method in ("", "none"):
        return data
    if method not in ("bz2", "lz4", "zstd"):
        raise CorruptDataError(f"compressed by {method[:40]!r}, which is not known")
    pieces = []
    size = 0
    try:
        for piece in _zstd_pieces(io.BytesIO(data)) if method == "zstd" else _pieces(data, method):
            size += len(piece)
            if size > MAX_RECORD:
                break
            pieces.append(piece)
    except CorruptDataError:
        if not cut:
            raise
    if size > MAX_RECORD:
        raise CorruptDataError(f"would unpack to more than {MAX_RECORD >> 20} MiB")
    return b"".join(pieces)


def unpack_file(source: Path, target: Path, limit: int) -> str | None:
    """Unpack a zstd file to `target`. Return the reason for an early stop, or None if the whole file was unpacked.

    limit: the largest unpacked size, bytes. The part that was unpacked before the stop stays in `target`.
    """
    size = 0
    with source.open("rb") as packed, target.open("wb") as out:
        try:
            for piece in _zstd_pieces(packed):
                size += len(piece)
                if size > limit:
                    return f"would unpack to more than {limit >> 20} MiB"
                out.write(piece)
        except CorruptDataError as error:
            return f"{error} after {size} bytes"
    return None


def _zstd_pieces(source: BinaryIO) -> Iterator[bytes]:
    import zstandard

    try:
        with zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True) as stream:
            while piece := stream.read(_PIECE):
                yield piece
    except zstandard.ZstdError as error:
        raise CorruptDataError(f"broken zstd data ({error})") from error


def _pieces(data: bytes, method: str) -> Iterator[bytes]:
    """Yield the unpacked pieces of bz2 or lz4 data."""
    import bz2

    import lz4.frame

    decompressor: Any = bz2.BZ2Decompressor() if method == "bz2" else lz4.frame.LZ4FrameDecompressor()
    while not decompressor.eof:
        try:
            piece = decompressor.decompress(data, max_length=_PIECE)
        except (OSError, RuntimeError, EOFError, ValueError) as error:
            raise CorruptDataError(f"broken compressed data ({error})") from error
        data = b""
        if piece:
            yield piece
        elif decompressor.needs_input:
            raise CorruptDataError("the compressed data end early")
