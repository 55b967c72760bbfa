"""Decompression that stops at a limit, and that gives what it can of data cut off in the middle."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from objslam.ros.bag.records import MAX_RECORD

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # The first bytes of zstd data.
_PIECE = 1 << 22  # The most bytes that are unpacked at once; larger: a limit is passed by more before it is seen.


class CorruptDataError(ValueError):
    """Data that cannot be unpacked; says why."""


def unpack(data: bytes, method: str, *, cut: bool = False, limit: int = MAX_RECORD) -> bytes:
    """The data unpacked: method "" or "none", "bz2", "lz4" (frame) or "zstd".

    cut: the data end early, and what can be unpacked of them is wanted. CorruptDataError where they are broken, would grow
    beyond `limit` bytes, or the method is unknown.
    """
    if method in ("", "none"):
        return data
    pieces = []
    size = 0
    for piece in _pieces(data, method, cut):
        size += len(piece)
        if size > limit:
            raise CorruptDataError(f"would unpack to more than {limit >> 20} MiB")
        pieces.append(piece)
    return b"".join(pieces)


def unpack_file(source: Path, target: Path, limit: int) -> str | None:
    """Unpack a zstd file into another; why it stopped early, None if all came out."""
    import zstandard

    size = 0
    with source.open("rb") as packed, target.open("wb") as out:
        try:
            with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as stream:
                while piece := stream.read(_PIECE):
                    size += len(piece)
                    if size > limit:
                        return f"would unpack to more than {limit >> 20} MiB"
                    out.write(piece)
        except zstandard.ZstdError as error:
            return f"broken zstd data after {size} bytes ({error})"
    return None


def _pieces(data: bytes, method: str, cut: bool) -> Iterator[bytes]:
    if method == "bz2":
        import bz2

        yield from _feed(bz2.BZ2Decompressor(), data, (OSError, EOFError, ValueError), cut)
    elif method == "lz4":
        import lz4.frame

        yield from _feed(lz4.frame.LZ4FrameDecompressor(), data, (RuntimeError, EOFError, ValueError), cut)
    elif method == "zstd":
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True)
        try:
            while piece := reader.read(_PIECE):
                yield piece
        except zstandard.ZstdError as error:
            if not cut:
                raise CorruptDataError(f"broken zstd data ({error})") from error
    else:
        raise CorruptDataError(f"compressed by {method[:40]!r}, which is not known")


def _feed(decompressor: Any, data: bytes, broken: tuple[type[Exception], ...], cut: bool) -> Iterator[bytes]:
    """What a decompressor of the bz2 kind makes of the data, piece by piece."""
    while not decompressor.eof:
        try:
            piece = decompressor.decompress(data, max_length=_PIECE)
        except broken as error:
            if cut:
                return
            raise CorruptDataError(f"broken compressed data ({error})") from error
        data = b""
        if piece:
            yield piece
        elif decompressor.needs_input:
            if cut:
                return
            raise CorruptDataError("the compressed data end early")
