"""Stores and sources in folders of this machine, or of a disk that all workers share."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from objslam.errors import OutputError
from objslam.fleet.stores.store import FileState, StoreError
from objslam.io.atomic_files import copy_files, write_file


def local_path(url: str) -> Path:
    """Return the path that a `file://` URL or a text names."""
    return Path(unquote(url.removeprefix("file://")) if url.startswith("file://") else url)


class LocalStore:
    """A store in a folder of this machine, or of a disk that all workers share."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.absolute()
        self.url = str(self._folder)

    def names(self, prefix: str) -> list[str]:
        """Return the sorted names of the files directly in the folder `prefix`, without the folder. A missing folder gives
        [].

        Names that begin with a dot are left out, because they are files that a write has not finished. StoreError if the
        folder cannot be read.
        """
        try:
            with os.scandir(self._folder / prefix) as entries:
                return sorted(entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise _failed(self._folder / prefix, error) from error

    def read(self, name: str) -> bytes:
        """Return the content of a file. FileNotFoundError if the file does not exist, StoreError if it cannot be read."""
        try:
            return (self._folder / name).read_bytes()
        except FileNotFoundError:
            raise
        except OSError as error:
            raise _failed(self._folder / name, error) from error

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of files by name. Files that do not exist are left out."""
        found = {}
        for name in names:
            try:
                found[name] = self.read(name)
            except FileNotFoundError:
                continue
        return found

    def write(self, name: str, data: bytes) -> None:
        """Write a file, and replace an older one. StoreError if it cannot be written.

        A write does not list the folder, because the folder may have a file for each of a million logs. So a write does not
        delete the temporary files of killed processes. `names` leaves these files out.
        """
        file = self._folder / name
        self._make(file.parent)
        with _refusals():
            write_file(file, data, tidy=False)

    def upload(self, folder: Path, name: str) -> list[str]:
        """Copy the files of a local folder into the folder `name`. Return the sorted names of the files, without the folder.

        StoreError if a file cannot be read or written. When this function returns, the files are on the disk. So a file that
        is written later may rely on them.
        """
        to = self._folder / name
        self._make(to)
        files = sorted(file for file in folder.iterdir() if file.is_file())
        with _refusals():
            copy_files(files, to)
        return [file.name for file in files]

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""
        (self._folder / name).unlink(missing_ok=True)

    def _make(self, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _failed(folder, error) from error


class LocalSource:
    """A source on the disk of this machine."""

    def expand(self, pattern: str) -> list[str]:
        """Return the sorted paths that a path or a glob pattern names. The list is empty if nothing is there."""
        path = Path(local_path(pattern))
        if os.path.lexists(path):
            return [str(path)]
        root = Path(path.anchor)
        return sorted(str(found) for found in root.glob(str(path.relative_to(root))))

    def files(self, path: str) -> Mapping[str, FileState]:
        """Return the state of each file below a path, by the file's relative name. If the path is a file, its relative name
        is ""."""
        root = Path(path)
        if root.is_file():
            return {"": _state(root)}
        found = {}
        for folder, inner, names in os.walk(root):
            inner.sort()
            below = PurePosixPath(Path(folder).relative_to(root).as_posix())
            for name in sorted(names):
                file = Path(folder, name)
                if file.is_file():  # A broken link is left out.
                    found[str(below / name)] = _state(file)
        return found

    def fetch(self, path: str, to: Path) -> Path:
        """Return the path itself, because the log is already on this machine. `to` has no effect."""
        return Path(path)


def _state(file: Path) -> FileState:
    found = file.stat()
    return FileState(found.st_size, str(found.st_mtime_ns))


@contextmanager
def _refusals() -> Iterator[None]:
    """Raise StoreError in place of the errors of a write. The log does not cause such errors, and a later try may
    succeed."""
    try:
        yield
    except OutputError as error:
        raise StoreError(error.message, where=error.where, hint=error.hint) from error


def _failed(path: Path, error: OSError) -> StoreError:
    return StoreError(f"cannot be read or written: {error.strerror or error}", where=str(path))
