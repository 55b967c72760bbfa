"""Write single files and sets of files atomically, so that a killed process leaves no partial result."""

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from objslam.errors import OutputError
from objslam.io.folders import remove_leftovers, temporary_name

_STAGING = ".objslam-staging"
_SWAPPING = "swapping"  # This file in the staging folder marks that the replacement of the old files has started.
_UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP, errno.ENOLCK, errno.ENOSYS)
"""The error codes of network file systems that cannot lock or sync a folder. They are ignored."""


@dataclass(frozen=True)
class FileSet:
    """The names of files that are replaced together."""

    seal: str  # The name of the file that is deleted first and written last. So this file exists only in a complete set.
    others: tuple[str, ...]  # The other files of the set, including optional files.
    pattern: str  # A glob pattern for files whose names vary.

    def names(self, folder: Path) -> tuple[str, ...]:
        """Return all names of the set: the seal, then `others`, then the files in the folder that match `pattern`."""
        return (self.seal, *self.others, *sorted(file.name for file in folder.glob(self.pattern)))


def try_folder(folder: Path, files: FileSet) -> None:
    """Create a folder and write a test file to it. Delete the temporary files of this set that killed processes left.

    Raises OutputError for a disk error, or if another run is writing to the folder.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with _staged(folder, files) as staging:
            for name in files.names(folder):
                remove_leftovers(folder / name)
            _write(staging / "probe", b"objslam")


def replace_files(folder: Path, files: FileSet, writers: dict[str, Callable[[Path], object]]) -> tuple[str, ...]:
    """Replace a set of files in a folder. Return the names of the old files that have no replacement.

    writers: maps the name of each new file to the function that writes it. New files are first written to a staging folder.
    All files of the old set are then deleted. At the end, the new files are renamed, the seal last. A killed process
    therefore never leaves a half-written file, a mix of two sets, or a seal in an incomplete set. Other files do not change.
    Raises OutputError for a disk error, or if another run is writing to the folder.
    """
    with disk_errors(folder), _staged(folder, files) as staging:
        for name, write in writers.items():
            write(staging / name)
            _sync(staging / name)
        _sync(staging)
        return _swap(staging, folder, files)


def is_cut_short(folder: Path, files: FileSet) -> bool:
    """Return whether the folder contains an incomplete set because `replace_files` was interrupted."""
    return (folder / _STAGING / _SWAPPING).exists() and not (folder / files.seal).exists()


def has_staging(folder: Path) -> bool:
    """Return whether a run is writing to the folder or was killed while writing."""
    return (folder / _STAGING).exists()


def write_file(file: Path, data: bytes, *, tidy: bool = True) -> None:
    """Write one file under a temporary name, then rename it to `file`. Raises OutputError with this name for a disk error.

    tidy: whether to first delete the temporary files of `file` that killed processes left. The search for these files lists
    the whole folder, so it takes long in a folder with many files.
    """
    with _replaced(file, tidy=tidy) as stream:
        stream.write(data)


def write_lines(file: Path, lines: Iterable[str]) -> None:
    """Write a text file line by line, as `write_file` does. Raises the errors of `write_file`, `encode` and `lines`."""
    with _replaced(file) as stream:
        for line in lines:
            stream.write(encode(f"{line}\n"))


def copy_files(files: Iterable[Path], folder: Path) -> None:
    """Copy files into an existing folder. Each file appears whole.

    The function returns when all copies are on the disk, so that a later power cut does not remove them. Raises OutputError
    for a disk error.
    """
    with disk_errors(folder):
        for file in files:
            final = folder / file.name
            remove_leftovers(final)
            temporary = final.with_name(temporary_name(final))
            try:
                shutil.copyfile(file, temporary)
                _sync(temporary)
                temporary.replace(final)
            finally:
                temporary.unlink(missing_ok=True)
        _sync(folder)


@contextmanager
def _replaced(file: Path, *, tidy: bool = True) -> Iterator[BinaryIO]:
    """Yield a stream to a temporary file. Rename this file to `file` at the end, or delete it after an error.

    tidy: as for `write_file`.
    """
    temporary = file.with_name(temporary_name(file))
    with disk_errors(file, only=True):
        if tidy:
            remove_leftovers(file)
        try:
            with temporary.open("wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(file)
            _sync(file.parent)
        finally:
            temporary.unlink(missing_ok=True)


def encode(text: str) -> bytes:
    """Return the text as UTF-8. Raises OutputError for an unpaired surrogate, which UTF-8 cannot represent."""
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        bad = error.object[max(error.start - 20, 0) : error.end]
        raise OutputError(f"text that cannot be written (an unpaired surrogate) near {bad!r}") from error


@contextmanager
def disk_errors(path: Path, *, only: bool = False) -> Iterator[None]:
    """Turn each OSError of the block into an OutputError that names the failing file.

    The error names `path` instead if the failing file is unknown, or if `only` is True.
    """
    try:
        yield
    except OSError as error:
        where = str(path if only or error.filename is None else error.filename)
        raise OutputError(f"cannot write or read: {error.strerror or error}", where=where) from error


def try_lock(stream: BinaryIO | int) -> bool:
    """Lock an open file without waiting. Return True if this call locked it, and False if another holder has the lock.

    stream: the file or its descriptor. Closing the file ends the lock. Raises OSError if the file system has no locks.
    """
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_locked(file: Path) -> bool:
    """Return whether a process holds the lock on a file. Return False if there is no such file, or if the file system has
    no locks.

    Raises OSError if the file cannot be read.
    """
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return _is_locked(stream.fileno())


def _is_locked(handle: int) -> bool:
    """Try to lock a descriptor. Return whether another holder has the lock, or False if the file system has no locks."""
    try:
        return not try_lock(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        return False


@contextmanager
def _staged(folder: Path, files: FileSet) -> Iterator[Path]:
    """Lock a folder and yield an empty staging folder in it. Delete what an interrupted run left in the folder."""
    staging = folder / _STAGING
    handle = os.open(folder, os.O_RDONLY)
    try:
        if _is_locked(handle):
            raise OutputError("another run is writing here", where=str(folder), hint="name another folder with -o")
        if staging.exists():  # The lock is free, so a killed run left this folder.
            if is_cut_short(folder, files):
                for name in files.names(folder):
                    (folder / name).unlink(missing_ok=True)
            shutil.rmtree(staging)
        staging.mkdir()
        try:
            yield staging
        finally:
            if not is_cut_short(folder, files):
                shutil.rmtree(staging, ignore_errors=True)
    finally:
        os.close(handle)


def _swap(staging: Path, folder: Path, files: FileSet) -> tuple[str, ...]:
    """Replace the old files by the staged files. Return the names of the old files that have no replacement.

    The order of the steps ensures that a killed process never leaves a mix of two sets.
    """
    old = files.names(folder)
    removed = tuple(name for name in old if (folder / name).exists() and not (staging / name).exists())
    _write(staging / _SWAPPING, b"")
    _sync(staging)
    for name in old:
        (folder / name).unlink(missing_ok=True)
        if name == files.seal:
            _sync(folder)
    _sync(folder)
    for name in reversed(files.names(staging)):
        if (staging / name).exists():
            if name == files.seal:
                _sync(folder)
            (staging / name).replace(folder / name)
    _sync(folder)
    return removed


def _write(file: Path, data: bytes) -> None:
    with file.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(handle)
