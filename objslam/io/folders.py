"""Remove empty folders after a failure."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def no_empty_folders(path: Path) -> Iterator[None]:
    """After an error in the block, delete those of `path` and its parents that the block created and left empty."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        with suppress(OSError):  # A folder with content remains, and so do its parents.
            for folder in made:
                if folder.exists():
                    folder.rmdir()
        raise
