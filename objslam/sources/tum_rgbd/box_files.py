"""Read the text files of detector boxes, each for one frame, from folders and tar archives."""

from __future__ import annotations

import lzma
import re
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections
from objslam.errors import LogError
from objslam.io.box_collector import BoxCollector
from objslam.io.text import parse_numbers, read_bytes, split_lines

_STAMPED = re.compile(r"(\d+\.\d+)\.txt")  # The name of a box file, a stamp in s.
_ARCHIVES = ("*.tar", "*.tar.gz", "*.tgz", "*.tar.bz2", "*.tar.xz")  # The names of archives that may hold box files.
_MAX_SIZE = 1 << 20  # The largest box file in an archive, bytes. A usual file has a few hundred bytes.
_BAD_ARCHIVE = (tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, OSError, ValueError)
"""The exceptions that reading a damaged archive raises."""


def find_box_sets(folder: Path) -> list[Path]:
    """Find the subfolders and the archives of a folder that hold box files."""
    folders = [f for f in sorted(folder.iterdir()) if f.is_dir() and any(_STAMPED.fullmatch(i.name) for i in f.iterdir())]
    archives = sorted({file for pattern in _ARCHIVES for file in folder.glob(pattern) if file.is_file()})
    return folders + [archive for archive in archives if _holds_boxes(archive)]


def read_box_set(source: Path, label: str, ledger: Ledger) -> Detections:
    """Read a set of box files in the order of their stamps. `label` is the label of boxes without a class.

    An archive is not unpacked to disk. Files that are not regular, files that are too large, and files not named after a
    stamp are dropped and counted. A damaged archive is read up to the damage, with a warning.
    Raises LogError if no file can be read.
    """
    files = _archive_files(source, ledger) if source.is_file() else _folder_files(source, ledger)
    collector = BoxCollector()
    for stamp, place, data in sorted(files, key=lambda file: file[0]):
        collector.add_frame(stamp, place)
        add_boxes(data, place, label, collector, ledger)
    if not collector.stamps:
        raise LogError("none of the box files can be read", where=str(source))
    return collector.checked(ledger)


def add_boxes(data: bytes, place: str, label: str, collector: BoxCollector, ledger: Ledger) -> None:
    """Add the boxes of a file to the collector's last frame. `place` names the file in messages.

    Each line is "[class] x y w h score" in px. The class is a COCO number. The point (x, y) is the box's top left corner.
    Boxes without a class get `label`. Malformed lines are dropped and counted.
    """
    for number, text in split_lines(data, place, ledger):
        where = f"{place}:{number}"
        values = parse_numbers(text.split())
        if values is None or len(values) not in (5, 6):
            ledger.drop('box line that is not "[class] x y w h score"', where=where)
            continue
        name = label
        if len(values) == 6:
            if values[0] not in range(len(COCO_NAMES)):
                ledger.drop("box line with a class number that is not in COCO", where=where)
                continue
            name = COCO_NAMES[int(values[0])]
        x, y, width, height, score = values[-5:]
        collector.add_box([x, y, x + width, y + height], name, score, where)


def _folder_files(folder: Path, ledger: Ledger) -> Iterator[tuple[float, str, bytes]]:
    for file in sorted(folder.iterdir()):
        match = _STAMPED.fullmatch(file.name)
        if match is None:
            ledger.drop("box file not named after a stamp", where=str(file))
        elif file.is_symlink() or not file.is_file():
            ledger.drop("box file that is not a regular file", where=str(file))
        else:
            yield float(match[1]), str(file), read_bytes(file)


def _archive_files(archive: Path, ledger: Ledger) -> Iterator[tuple[float, str, bytes]]:
    try:
        with tarfile.open(archive) as members:
            for member in members:
                name = member.name.rpartition("/")[2]
                place = f"{archive}:{name}"
                match = _STAMPED.fullmatch(name)
                if member.isdir():
                    continue
                if not member.isreg():
                    ledger.drop("box file that is not a regular file", where=place)
                elif match is None:
                    ledger.drop("box file not named after a stamp", where=place)
                elif member.size > _MAX_SIZE:
                    ledger.drop("box file that is too large", where=place)
                elif content := members.extractfile(member):
                    yield float(match[1]), place, content.read()
    except _BAD_ARCHIVE as error:
        ledger.warn(f"{archive}: damaged or cut off, the rest of the archive is left out ({error})")


def _holds_boxes(archive: Path) -> bool:
    try:
        with tarfile.open(archive) as members:
            return any(member.isreg() and _STAMPED.fullmatch(member.name.rpartition("/")[2]) for member in members)
    except _BAD_ARCHIVE:
        return False
