"""Check that the files in the lists of a log are inside its folder."""

import os
import stat
from pathlib import Path


class Inside:
    """A check that a path, after symbolic links are resolved, is a regular file inside a folder."""

    def __init__(self, folder: Path) -> None:
        self._root = os.path.realpath(folder)
        self._folders: dict[str, bool] = {}  # A cache, because the many files of a log are in few folders.

    def reason_against(self, path: Path) -> str | None:
        """Return the reason to reject a path, or None if the path is a regular file inside the folder."""
        folder = str(path.parent)
        if folder not in self._folders:
            self._folders[folder] = self._contains(folder)
        if not self._folders[folder]:
            return "leaves the folder"
        try:
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                if not self._contains(path):
                    return "leaves the folder"
                mode = path.stat().st_mode
        except (OSError, ValueError):  # A path with a NUL character raises ValueError.
            return "is missing"
        return None if stat.S_ISREG(mode) else "is not a regular file"

    def _contains(self, path: str | Path) -> bool:
        try:
            return os.path.commonpath([self._root, os.path.realpath(path)]) == self._root
        except (OSError, ValueError):
            return False
