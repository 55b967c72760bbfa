"""Image lists in TUM format, rgb.txt and depth.txt: "stamp relative/path" a line, '#' comments."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import numpy as np

from objslam.errors import LogError
from objslam.ledger import Ledger
from objslam.sources.textfile import count_drops, in_order, parse_numbers, read_lines
from objslam.types import Images


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


def read_images(path: Path, ledger: Ledger) -> Images:
    """Read an image list; the images are found, not opened.

    Dropped and counted: malformed lines, stamps that repeat or go back, files that are missing or leave the list's folder
    (absolute, '..', symbolic links). LogError where no image is left.
    """
    folder = path.parent
    inside = Inside(folder)
    name = path.name
    stamps, files, places = [], [], []
    lines = read_lines(path, ledger)
    for number, text in lines:
        place = f"{path}:{number}"
        first, *rest = text.split(maxsplit=1)
        stamp = parse_numbers([first])
        if stamp is None or not np.isfinite(stamp[0]) or not rest:
            ledger.drop(f'{name} line that is not "stamp path"', where=place)
            continue
        relative = Path(rest[0])
        file = folder / relative
        outside = relative.is_absolute() or ".." in relative.parts
        reason = "leaves the folder" if outside else inside.reason_against(file)
        if reason is not None:
            ledger.drop(f"{name} line whose file {reason}", where=place)
            continue
        stamps.append(stamp[0])
        files.append(file)
        places.append(place)
    times = np.array(stamps, dtype=np.float64)
    forward = in_order(times)
    late = np.flatnonzero(~forward)
    count_drops(f"{name} line with a stamp that repeats or goes back", len(late), (places[i] for i in late), ledger)
    if not forward.any():
        state = f"none of its {len(lines)} lines leads to an image" if lines else "nothing in it"
        raise LogError(state, where=str(path), hint='a line is "stamp path", the path relative to this file')
    return Images(times[forward], tuple(files[i] for i in np.flatnonzero(forward)))


def write_images(images: Images, path: Path) -> None:
    """Write an image list; the paths are made relative to the list's folder, where they must lie."""
    pairs = zip(images.stamps.tolist(), images.paths, strict=True)
    text = "".join(f"{stamp!r} {file.relative_to(path.parent).as_posix()}\n" for stamp, file in pairs)
    path.write_text("# stamp path\n" + text, encoding="utf-8")
