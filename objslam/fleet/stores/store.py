"""The types of the sources from which a fleet reads logs, and of the stores in which it keeps results."""

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
    """The state of a file in a listing. size: the size, bytes. stamp: a text that changes with the content, such as an ETag,
    a checksum or the time of the last change."""

    size: int
    stamp: str


class Store(Protocol):
    """A tree of files in which results are kept. A file's name is its path below the store, with slashes. A file appears
    only when it is complete."""

    url: str

    def names(self, prefix: str) -> list[str]:
        """Return the sorted names of the files directly in the folder `prefix`, without the folder. A missing folder gives
        []."""

    def read(self, name: str) -> bytes:
        """Return the content of a file. FileNotFoundError if the file does not exist, StoreError if the store does not
        answer."""

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of files by name. Files that do not exist are left out."""

    def write(self, name: str, data: bytes) -> None:
        """Write a file, and replace an older one. StoreError if it cannot be written."""

    def upload(self, folder: Path, name: str) -> list[str]:
        """Copy the files of a local folder into the folder `name`. Return the sorted names of the files, without the
        folder."""

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""


class Source(Protocol):
    """A tree of files that contains logs. Its paths are paths of this machine, or whole URLs."""

    def expand(self, pattern: str) -> list[str]:
        """Return the sorted paths that a path or a glob pattern names. The list is empty if nothing is there."""

    def files(self, path: str) -> Mapping[str, FileState]:
        """Return the state of each file below a path, by the file's relative name. If the path is a file, its relative name
        is ""."""

    def fetch(self, path: str, to: Path) -> Path:
        """Return the local path of a log. It is the path of the log itself, or of a copy in the folder `to`."""
