"""Files that are written whole or not at all: one by itself, or a set of them that share a folder."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from objslam.errors import OutputError

_STAGING = ".objslam-staging"
_SWAPPING = "swapping"
"""In the staging folder from before the first old file goes: what a killed swap left beside it is no one's but ours."""
_UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP, errno.ENOLCK, errno.ENOSYS)
"""What network file systems answer that can neither lock nor sync a folder: there we go on without."""


@dataclass(frozen=True)
class FileSet:
    """The names of the files that are replaced together.

    seal: the file that stands for the whole: it goes first and comes last. others: the rest, whether written each time or
    not. pattern: a glob, for those whose names are not known beforehand.
    """

    seal: str
    others: tuple[str, ...]
    pattern: str

    def names(self, folder: Path) -> tuple[str, ...]:
        """Every name of the set that may be in a folder, the seal first."""
        return (self.seal, *self.others, *sorted(file.name for file in folder.glob(self.pattern)))


def try_folder(folder: Path, files: FileSet) -> None:
    """Make a folder and try to write there; OutputError where `replace_files` could not."""
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with _staged(folder, files) as staging:
            _write(staging / "probe", b"objslam")


def replace_files(folder: Path, files: FileSet, writers: dict[str, Callable[[Path], object]]) -> tuple[str, ...]:
    """Write a set of files into a folder, in place of an older one; other files there stay.

    The new files are first written to a staging folder. Then all files of the old set are deleted. Then the new files are
    renamed into place, the seal last. If the process is killed at any moment, the folder never holds a half-written file or
    a mix of two sets. It holds the seal only if the set is complete.

    Args:
        writers: the function that writes each file, by the name of the file, which must be a name of the set.
    Returns:
        The names of the old files that were deleted and not replaced.
    Raises:
        OutputError: the disk refuses, or another run writes there.
    """
    with disk_errors(folder), _staged(folder, files) as staging:
        for name, write in writers.items():
            write(staging / name)
            _sync(staging / name)
        _sync(staging)
        return _swap(staging, folder, files)


def is_cut_short(folder: Path, files: FileSet) -> bool:
    """Whether a swap began in the folder and did not end: then it holds parts of a set."""
    return (folder / _STAGING / _SWAPPING).exists() and not (folder / files.seal).exists()


def has_staging(folder: Path) -> bool:
    """Whether a set is being written in the folder, or a run was killed while it did."""
    return (folder / _STAGING).exists()


def write_file(file: Path, data: bytes) -> None:
    """Write one file under a temporary name and rename it; OutputError, with the file's own name, when the disk refuses."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    with disk_errors(file, only=True):
        try:
            _write(temporary, data)
            temporary.replace(file)
            _sync(file.parent)
        finally:
            temporary.unlink(missing_ok=True)


def encode(text: str) -> bytes:
    """Text as UTF-8; OutputError where it holds half of a surrogate pair, which no file can."""
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        bad = error.object[max(error.start - 20, 0) : error.end]
        raise OutputError(f"text that cannot be written (half of a surrogate pair) near {bad!r}") from error


@contextmanager
def disk_errors(path: Path, *, only: bool = False) -> Iterator[None]:
    """What the disk refuses, as an OutputError of one line; it names the file in question, or (only) always the path."""
    try:
        yield
    except OSError as error:
        where = str(path if only or error.filename is None else error.filename)
        raise OutputError(f"cannot write or read: {error.strerror or error}", where=where) from error


@contextmanager
def _staged(folder: Path, files: FileSet) -> Iterator[Path]:
    """An empty staging folder in a folder, and that one to ourselves as long as the process lives; gone afterwards.

    A swap that was cut short leaves it, as the sign of whose the rest is; here that rest goes too. OutputError when another
    run has it.
    """
    staging = folder / _STAGING
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            hint = "name another folder with -o"
            raise OutputError("another run is writing here", where=str(folder), hint=hint) from error
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
        if staging.exists():  # a killed run left it: the lock says that nobody is at it
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
    """Put the staged files in the place of the old ones; the order is what keeps a killed run from a mix."""
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
