"""Folders that are made for work that may fail."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def no_empty_folders(path: Path) -> Iterator[None]:
    """Work that makes a folder, with its parents: where it fails, those that it made and left empty are taken away again."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        with suppress(OSError):  # not empty: it stays, and so do its parents
            for folder in made:
                if folder.exists():
                    folder.rmdir()
        raise
