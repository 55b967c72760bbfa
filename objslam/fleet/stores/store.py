"""The stores of a fleet: where logs are read and results are kept."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from objslam.errors import ObjslamError


class StoreError(ObjslamError):
    """A store does not answer, or does not allow the access. A later try may succeed."""


@dataclass(frozen=True, slots=True)
class FileState:
    """A file in a listing. size: bytes. stamp: a text that changes with the content: an ETag, a checksum or the time of the
    last change."""

    size: int
    stamp: str


class Store(Protocol):
    """A tree of files. A name is a path below the store, with slashes. A file that is written appears whole."""

    url: str

    def names(self, prefix: str) -> list[str]:
        """Return the names of the files directly in the folder `prefix`, without the folder, in order."""

    def read(self, name: str) -> bytes:
        """Return the content of a file. FileNotFoundError if there is none, StoreError if the store does not answer."""

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of files by name. Files that do not exist are left out."""

    def write(self, name: str, data: bytes) -> None:
        """Write a file, and replace an older one. StoreError if it cannot be written."""

    def upload(self, folder: Path, name: str) -> list[str]:
        """Copy the files of a local folder into the folder `name`. Return their names without the folder, in order."""

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""


class Source(Protocol):
    """A tree of files that has logs. Its paths are paths of this machine, or whole URLs."""

    def expand(self, pattern: str) -> list[str]:
        """Return the paths that a path or a glob pattern names, in order; none if nothing is there."""

    def files(self, path: str) -> Mapping[str, FileState]:
        """Return every file below a path, by its relative name. A path of a file gives this file, named ""."""

    def fetch(self, path: str, to: Path) -> Path:
        """Return a local path with the content of a log. It is the log itself, or a copy in the folder `to`."""
