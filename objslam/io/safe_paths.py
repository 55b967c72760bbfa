"""Files that a log names must lie inside the log."""

from __future__ import annotations

import os
import stat
from pathlib import Path


class Inside:
    """Tells which files are regular files that lie inside a folder, symbolic links followed."""

    def __init__(self, folder: Path) -> None:
        self._root = os.path.realpath(folder)
        self._folders: dict[str, bool] = {}  # the many files of a log lie in few folders: each is followed once

    def reason_against(self, path: Path) -> str | None:
        """Why the path, below the folder as it is written, is not to be used; None if it is."""
        if not self._folder_inside(str(path.parent)):
            return "leaves the folder"
        try:
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                if not self._within(os.path.realpath(path)):
                    return "leaves the folder"
                mode = path.stat().st_mode
        except (OSError, ValueError):  # ValueError: a NUL in the path
            return "is missing"
        return None if stat.S_ISREG(mode) else "is not a regular file"

    def _folder_inside(self, folder: str) -> bool:
        if folder not in self._folders:
            try:
                self._folders[folder] = self._within(os.path.realpath(folder))
            except (OSError, ValueError):
                self._folders[folder] = False
        return self._folders[folder]

    def _within(self, real: str) -> bool:
        return os.path.commonpath([self._root, real]) == self._root
