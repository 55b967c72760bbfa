"""Open the store or the source at a path or URL."""

from __future__ import annotations

from objslam.fleet.stores.local_store import LocalSource, LocalStore, local_path
from objslam.fleet.stores.remote_store import RemoteSource, RemoteStore
from objslam.fleet.stores.store import Source, Store


def is_remote(url: str) -> bool:
    """Return whether a path or URL needs fsspec."""
    scheme, mark, _ = url.partition("://")
    return bool(mark) and scheme != "file"


def open_store(url: str) -> Store:
    """Return the store at a path or URL. For a remote URL, the errors are those of `open_filesystem`."""
    if is_remote(url):
        return RemoteStore(url)
    return LocalStore(local_path(url))


def open_source(url: str) -> Source:
    """Return the source that can read a path or URL. The errors are those of `open_store`."""
    if is_remote(url):
        return RemoteSource(url)
    return LocalSource()
