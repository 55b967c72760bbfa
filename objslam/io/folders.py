"""Remove the remains of failed or killed work from the disk: empty folders, temporary files and temporary folders."""

import os
import platform
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

OLD = "old"
"""The name of a folder inside a temporary folder. The folder that is being replaced has this name until the end."""


@contextmanager
def no_empty_folders(path: Path) -> Iterator[None]:
    """If the block raises an error, delete the empty folders that the block created, among `path` and its parents."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        with suppress(OSError):  # A folder with content remains. Its parents also remain.
            for folder in made:
                if folder.exists():
                    folder.rmdir()
        raise


def temporary_name(path: Path) -> str:
    """Return the name of a temporary file or folder beside `path`. The name contains the machine and the process.

    `remove_leftovers` finds the owner by this name. The process may append a dot and more letters to the name.
    """
    return f".{path.name}.{_machine()}-{os.getpid()}"


def remove_leftovers(path: Path) -> None:
    """Delete the temporary files and folders beside `path` that dead processes of this machine left.

    Their names are from `temporary_name`. A process that was killed while it replaced the folder `path` may have left the
    old folder in a temporary folder. If nothing is at `path` now, the old folder is moved back first. Files of other
    machines stay, because their processes may be alive. Raises OSError if the folder cannot be changed.
    """
    ours = re.compile(rf"\.{re.escape(path.name)}\.{_machine()}-([0-9]{{1,9}})(?:\..*)?", re.DOTALL)
    for entry in list(path.parent.iterdir()) if path.parent.is_dir() else []:
        found = ours.fullmatch(entry.name)
        if found is None or _is_alive(int(found[1])):
            continue
        if entry.is_dir() and not entry.is_symlink():
            if (entry / OLD).is_dir() and not path.exists():
                (entry / OLD).rename(path)
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def _machine() -> str:
    """Return a short text that identifies this machine or container. A process number is valid only on its own machine."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # The process belongs to another user, so it is alive.
        return True
    return True
