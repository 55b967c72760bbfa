"""A cache on disk of the boxes that a detector found, so that a second run does not detect again.

Each detector has one file, named by its key (model and recipe). Each line has a checksum and the results of one image as
JSON: the SHA-256 of the image file, the image size and the boxes. The SHA-256 identifies an image even if the log is moved,
copied or rendered again. Each line is appended in one write, so processes can share the file. A line whose checksum does not
match is dropped.
"""

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
    """The cached results of one image: its size in px and its boxes."""

    width: int
    height: int
    boxes: Boxes


class DetectionCache:
    """The cache file of one detector, as a context manager. One thread may read while another thread writes."""

    def __init__(self, folder: Path, key: str, ledger: Ledger) -> None:
        """Open the cache of the detector with this key. Damaged lines are dropped and counted. If the cache cannot be opened
        or written, the ledger gets a warning, and the cache stores no further entries."""
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
        """Return the entry of the image whose content has this SHA-256. Return None if the cache has no such entry."""
        line = self._lines.get(digest)
        if line is None:
            return None
        found = json.loads(line.partition(b" ")[2])
        boxes = np.array(found["boxes"], dtype=np.float64).reshape(-1, 4)
        width, height = found["size"]
        return Entry(width, height, Boxes(boxes, tuple(found["labels"]), np.array(found["scores"], dtype=np.float64)))

    def write(self, digest: str, entry: Entry) -> None:
        """Append the entry of an image to the file."""
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
    """Return the user's folder for detection caches, below XDG_CACHE_HOME or ~/.cache. Return None without a home folder."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # the XDG specification ignores relative paths
        try:
            base = Path.home() / ".cache"
        except RuntimeError:
            return None
    return base / "objslam" / "detections"


def _digest_of(line: bytes) -> str | None:
    """Return the image digest in a line, or None if the line is damaged."""
    check, _, text = line.partition(b" ")
    start, end = b'{"image": "', b'", "size": '
    if check != b"%08x" % zlib.crc32(text) or not text.startswith(start):
        return None
    return text[len(start) : text.index(end)].decode()
