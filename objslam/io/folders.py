"""Remove empty folders after a failure."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def no_empty_folders(path: Path) -> Iterator[None]:
    """Delete the folder `path` and its parents after an error, if the block created them and left them empty."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        with suppress(OSError):  # A folder with content remains, and so do its parents.
            for folder in made:
                if folder.exists():
                    folder.rmdir()
        raise
