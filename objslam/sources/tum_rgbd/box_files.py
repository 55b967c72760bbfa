"""A set of box files that are named after the stamp of their frame: a folder, or a tar archive read where it is."""

from __future__ import annotations

import lzma
import re
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections
from objslam.errors import LogError
from objslam.io.box_collector import BoxCollector
from objslam.io.text import read_bytes
from objslam.sources.tum_rgbd.box_text import add_boxes

_STAMPED = re.compile(r"(\d+\.\d+)\.txt")  # the name of a file of boxes is its stamp, s
_ARCHIVES = ("*.tar", "*.tar.gz", "*.tgz", "*.tar.bz2", "*.tar.xz")  # names of archives that may hold files of boxes
_MAX_SIZE = 1 << 20  # bytes; a file of boxes has a few hundred, a larger one is dropped
_BAD_ARCHIVE = (tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, OSError, ValueError)  # what a damaged one raises


def find_box_sets(folder: Path) -> list[Path]:
    """The folders and archives right below a folder that hold box files named after stamps."""
    folders = [f for f in sorted(folder.iterdir()) if f.is_dir() and any(_STAMPED.fullmatch(i.name) for i in f.iterdir())]
    archives = sorted({file for pattern in _ARCHIVES for file in folder.glob(pattern) if file.is_file()})
    return folders + [archive for archive in archives if _holds_boxes(archive)]


def read_box_set(source: Path, label: str, ledger: Ledger) -> Detections:
    """The detections of a set of box files, in the order of their stamps; `label` where the files name no class.

    An archive is read without unpacking it: members that are no regular files, that are too large, or whose name is no stamp
    are dropped and counted; of an archive that is cut off, what comes before is read, with a warning. LogError where no file
    can be read.
    """
    files = _archive_files(source, ledger) if source.is_file() else _folder_files(source, ledger)
    collector = BoxCollector()
    for stamp, place, data in sorted(files, key=lambda file: file[0]):
        collector.add_frame(stamp, place)
        add_boxes(data, place, label, collector, ledger)
    if not collector.stamps:
        raise LogError("no box file in it can be read", where=str(source))
    return collector.checked(ledger)


def _folder_files(folder: Path, ledger: Ledger) -> Iterator[tuple[float, str, bytes]]:
    for file in sorted(folder.iterdir()):
        match = _STAMPED.fullmatch(file.name)
        if match is None:
            ledger.drop("box file whose name is no stamp", where=str(file))
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
                    ledger.drop("box file whose name is no stamp", where=place)
                elif member.size > _MAX_SIZE:
                    ledger.drop("box file that is too large", where=place)
                elif content := members.extractfile(member):
                    yield float(match[1]), place, content.read()
    except _BAD_ARCHIVE as error:
        ledger.warn(f"{archive}: damaged or cut off, what comes after is left out ({error})")


def _holds_boxes(archive: Path) -> bool:
    try:
        with tarfile.open(archive) as members:
            return any(member.isreg() and _STAMPED.fullmatch(member.name.rpartition("/")[2]) for member in members)
    except _BAD_ARCHIVE:
        return False
