"""Stores and sources on object storage, through fsspec. A call that fails is tried again after a pause."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

from objslam.errors import ConfigError, ObjslamError, first_line
from objslam.fleet.stores.store import FileState, StoreError

_TRIES = 5
"""The maximum number of tries of a call to a store. With a larger number, a call survives longer faults, but the error for a
store that never answers comes later."""
_PAUSE = 0.1
"""The pause (s) after the first failed try of a call. The pause doubles after each further failed try. With a larger value,
a busy store gets more rest."""
_STAMPS = ("ETag", "etag", "md5Hash", "crc32c", "generation", "content_settings", "mtime", "LastModified", "created")
"""The keys of fsspec's file information whose values change with the content of the file. The most reliable key comes
first."""
_MAGIC = re.compile(r"[*?\[]")  # The characters that only glob patterns have.
_SAFE = re.compile(r"(?!(.*/)?\.\.?(/|$))[^\0]*")
"""The pattern of file names that stay below their folder. No part of such a name is "." or ".."."""

_T = TypeVar("_T")


def open_filesystem(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path of the URL in it.

    ObjslamError if fsspec, or the package of the protocol, is not installed, or if the protocol is unknown.
    """
    try:
        import fsspec
    except ModuleNotFoundError as error:
        raise ObjslamError("URLs need fsspec", where=url, hint="pip install objslam[fleet]") from error
    try:
        filesystem, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise ObjslamError(first_line(error), where=url, hint="pip install s3fs or gcsfs, for example") from error
    except ValueError as error:
        raise ObjslamError(f"no file system for this URL: {first_line(error)}", where=url) from error
    return filesystem, str(path).rstrip("/")


def persistent(call: Callable[[], _T], where: str) -> _T:
    """Return what a call to a store returns. The call is tried up to `_TRIES` times.

    where: the name of the file for messages. FileNotFoundError if the file does not exist, and StoreError if access is
    denied, both without another try. After the last try, any other OSError becomes a StoreError.
    """
    pause = _PAUSE
    for left in range(_TRIES - 1, -1, -1):
        try:
            return call()
        except FileNotFoundError:
            raise
        except PermissionError as error:
            raise StoreError(f"access is denied: {first_line(error)}", where=where) from error
        except OSError as error:
            if not left:
                raise StoreError(f"the store failed {_TRIES} times: {first_line(error)}", where=where) from error
        time.sleep(pause)
        pause *= 2
    raise AssertionError  # The last try returns or raises.


class RemoteStore:
    """A store in a folder of an object store."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._fs, self._root = open_filesystem(url)

    def names(self, prefix: str) -> list[str]:
        """Return the sorted names of the files directly in the folder `prefix`, without the folder. A missing folder gives
        []."""
        try:
            entries = self._try(prefix, lambda path: self._fs.ls(path, detail=True))
        except FileNotFoundError:
            return []
        return sorted(str(one["name"]).rpartition("/")[2] for one in entries if one["type"] == "file")

    def read(self, name: str) -> bytes:
        """Return the content of a file. FileNotFoundError if the file does not exist, StoreError if the store does not
        answer."""
        return bytes(self._try(name, self._fs.cat_file))

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of files by name. The files are read in parallel. Files that do not exist are left out."""
        wanted = {self._at(name): name for name in names}
        found: dict[str, bytes] = {}
        answers = self._try("", lambda _: self._fs.cat(list(wanted), on_error="return")) if wanted else {}
        for path, name in wanted.items():
            answer = answers.get(path)
            if isinstance(answer, bytes):
                found[name] = answer
            elif not isinstance(answer, FileNotFoundError):
                with suppress(FileNotFoundError):
                    found[name] = self.read(name)
        return found

    def write(self, name: str, data: bytes) -> None:
        """Write a file, and replace an older one. StoreError if it cannot be written."""
        self._parent(name)
        self._try(name, lambda path: self._fs.pipe_file(path, data))

    def upload(self, folder: Path, name: str) -> list[str]:
        """Copy the files of a local folder into the folder `name`. Return the sorted names of the files, without the
        folder."""
        names = sorted(file.name for file in folder.iterdir() if file.is_file())
        here, there = [str(folder / one) for one in names], [self._at(f"{name}/{one}") for one in names]
        self._parent(f"{name}/x")
        self._try(name, lambda _: self._fs.put(here, there))
        return names

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""
        try:
            self._try(name, self._fs.rm_file)
        except FileNotFoundError:
            return

    def _at(self, name: str) -> str:
        return f"{self._root}/{name}" if name else self._root

    def _parent(self, name: str) -> None:
        """Make the folder of a file. The call has no effect on object stores, which have no folders."""
        self._try(name.rpartition("/")[0], lambda path: self._fs.makedirs(path, exist_ok=True))

    def _try(self, name: str, call: Callable[[str], _T]) -> _T:
        return persistent(lambda: call(self._at(name)), f"{self.url}/{name}")


class RemoteSource:
    """A source in the store that holds a URL. It only reads."""

    def __init__(self, url: str) -> None:
        self._scheme = url.partition("://")[0]
        self._fs = open_filesystem(url)[0]

    def expand(self, pattern: str) -> list[str]:
        """Return the sorted URLs that a URL or a glob pattern names. The list is empty if nothing is there. ConfigError if
        the pattern contains `**`."""
        path = self._path(pattern)
        if "**" in path:
            raise ConfigError(f"** is not known in URLs: {pattern}", hint="name a folder, which is searched for logs")
        found, first = [path], next((n for n, part in enumerate(path.split("/")) if _MAGIC.search(part)), None)
        if first is not None:
            parts = path.split("/")
            found = ["/".join(parts[:first])]
            for part in parts[first:]:
                found = [
                    one for folder in found for one in self._inside(folder) if fnmatchcase(one.rpartition("/")[2], part)
                ]
        return [self._url(one) for one in sorted(found) if first is not None or self._exists(one)]

    def files(self, path: str) -> Mapping[str, FileState]:
        """Return the state of each file below a URL, by the file's relative name. If the URL is a file, its relative name is
        ""."""
        root = self._path(path)
        found = self._try(path, lambda: self._fs.find(root, detail=True)) if self._is_flat() else self._walk(root)
        return {str(name)[len(root) :].lstrip("/"): _state(info) for name, info in sorted(found.items())}

    def fetch(self, path: str, to: Path) -> Path:
        """Copy a log into the folder `to`, and return the path of the copy. StoreError if the name of a file leads out of
        the log."""
        root = self._path(path)
        copy = to / root.rpartition("/")[2]
        names = list(self.files(path))
        if bad := next((name for name in names if not _SAFE.fullmatch(name)), None):
            raise StoreError(f"the name {bad!r} leaves the log", where=path)
        here = [copy / name if name else copy for name in names]
        for file in here:
            file.parent.mkdir(parents=True, exist_ok=True)
        there = [f"{root}/{name}" if name else root for name in names]
        self._try(path, lambda: self._fs.get(there, [str(file) for file in here]))
        return copy

    def _is_flat(self) -> bool:
        """Return whether the file system lists all files below a path in few calls, as object stores do.

        Such a file system has its own `find`. The general `find` of fsspec lists folder by folder, and leaves out a folder
        whose listing fails.
        """
        from fsspec.asyn import AsyncFileSystem

        return isinstance(self._fs, AsyncFileSystem) and type(self._fs)._find is not AsyncFileSystem._find

    def _walk(self, root: str) -> dict[str, Any]:
        """Return the information on each file below a path, by the file's path. Folders are listed one by one. If a listing
        fails, only this listing is repeated."""
        found, left = {}, [root]
        while left:
            for name, info in self._inside(left.pop()).items():
                if info["type"] == "directory":
                    left.append(name)
                else:
                    found[name] = info
        return found

    def _inside(self, folder: str) -> dict[str, Any]:
        """Return the information on each entry directly in a folder, by the entry's path. If `folder` is a file, it is the
        only entry. A missing path has no entries."""
        try:
            entries = self._try(folder, lambda: self._fs.ls(folder, detail=True))
        except FileNotFoundError:
            return {}
        named = {str(one["name"]).rstrip("/"): one for one in entries}
        return {name: one for name, one in named.items() if name != folder or one["type"] == "file"}

    def _exists(self, path: str) -> bool:
        """Return whether something is at a path. The `exists` of fsspec is not used, because it also returns False if the
        store does not answer."""
        try:
            self._try(path, lambda: self._fs.info(path))
        except FileNotFoundError:
            return False
        return True

    def _path(self, url: str) -> str:
        return str(self._fs._strip_protocol(url)).rstrip("/")

    def _url(self, path: str) -> str:
        return f"{self._scheme}://{str(path).lstrip('/') if self._scheme in ('s3', 'gs') else path}"

    def _try(self, where: str, call: Callable[[], _T]) -> _T:
        return persistent(call, where)


def _state(info: Mapping[str, Any]) -> FileState:
    stamp = next((info[key] for key in _STAMPS if info.get(key) is not None), "")
    return FileState(int(info.get("size") or 0), str(stamp))
