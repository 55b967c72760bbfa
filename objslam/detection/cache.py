"""What a detector found in an image, kept on disk: a second run does not detect again.

One file a detector (its key: model and recipe), one line an image: a checksum, and as JSON the SHA-256 of the image file's
content and what was found. The content names the image, not its path or time: a log that was moved, copied or rendered again
gets the boxes that are its own. Lines are only ever appended, each in one write, so that processes may share the file;
what a killed one left half is told by its checksum and passed over.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from objslam.core.diagnostics import Ledger
from objslam.detection.detector import Boxes


@dataclass(frozen=True)
class Entry:
    """The size of an image, px, and what is in it."""

    width: int
    height: int
    boxes: Boxes


class DetectionCache:
    """The entries of one detector. To be used in a `with` block; one thread may read while another writes."""

    def __init__(self, folder: Path, key: str, ledger: Ledger) -> None:
        """Open the cache of the detector with this key; lines that are damaged are dropped and counted.

        A cache that cannot be opened or, later, written is told in a warning and does without.
        """
        self._file = folder / f"{key}.jsonl"
        self._ledger = ledger
        self._lines: dict[str, bytes] = {}
        self._handle = -1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            data = self._file.read_bytes()
            if data and not data.endswith(b"\n"):
                os.write(self._handle, b"\n")
        except OSError as error:
            self._give_up(error)
            return
        for number, line in enumerate(data.split(b"\n"), start=1):
            digest = _digest_of(line)
            if digest is not None:
                self._lines[digest] = line
            elif line:
                ledger.drop("damaged line of the detection cache", where=f"{self._file}:{number}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def read(self, digest: str) -> Entry | None:
        """What is known of the image whose content has this SHA-256, None if nothing is."""
        line = self._lines.get(digest)
        return None if line is None else _parse(line)

    def write(self, digest: str, entry: Entry) -> None:
        """Keep what was found in an image."""
        if self._handle < 0:
            return
        found = {
            "image": digest,
            "size": [entry.width, entry.height],
            "boxes": entry.boxes.boxes.tolist(),
            "labels": list(entry.boxes.labels),
            "scores": entry.boxes.scores.tolist(),
        }
        text = json.dumps(found, allow_nan=False).encode()
        line = b"%08x %b\n" % (zlib.crc32(text), text)
        try:
            if os.write(self._handle, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.__exit__()
        self._ledger.warn(f"{self._file}: the detection cache cannot be used: {error.strerror or error}")


def default_cache() -> Path | None:
    """The user's folder for detection caches: below XDG_CACHE_HOME, else ~/.cache; None where there is no home."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # the specification has relative paths ignored
        try:
            base = Path.home() / ".cache"
        except RuntimeError:
            return None
    return base / "objslam" / "detections"


def _digest_of(line: bytes) -> str | None:
    """The image's digest in a line, None if the line is not what was written."""
    check, _, text = line.partition(b" ")
    start, end = b'{"image": "', b'", "size": '
    if check != b"%08x" % zlib.crc32(text) or not text.startswith(start):
        return None
    return text[len(start) : text.index(end)].decode()


def _parse(line: bytes) -> Entry:
    found = json.loads(line.partition(b" ")[2])
    boxes = np.array(found["boxes"], dtype=np.float64).reshape(-1, 4)
    scores = np.array(found["scores"], dtype=np.float64)
    width, height = found["size"]
    return Entry(width, height, Boxes(boxes, tuple(found["labels"]), scores))
