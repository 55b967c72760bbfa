"""Describe a path that no source reads, and say what to do with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from objslam.errors import LogError
from objslam.io.text import reading
from objslam.sources.log_folder import CAMERA, CAMERAS, LOCALIZATION, ODOMETRY, RGB

_VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg"}
_ARCHIVES = {".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"}
_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".webp"}
_LOOKED_AT = 20  # The largest number of subfolders that are searched for recordings and images. More subfolders take longer.
_SHOWN = 3  # The largest number of names in a message.
_NEEDED = f"a log folder has {CAMERA}, {ODOMETRY} or {LOCALIZATION}, and detections.jsonl or {RGB}.txt"


def unknown_recording(path: Path, is_recording: Callable[[Path], bool], looked_for: str) -> LogError:
    """Return the error for a path that is no recording.

    is_recording: the function that returns whether a source can read a path. looked_for: a text that names the files of each
    source. Raises LogError if the path cannot be read.
    """
    with reading(path):
        what, hint = _folder(path, is_recording, looked_for) if path.is_dir() else _file(path)
    return LogError(f"nothing here that objslam reads: {what}", where=str(path), hint=hint)


def _file(path: Path) -> tuple[str, str]:
    """Return a description of a file, and a hint for the user."""
    ending = path.suffix.lower()
    if not path.is_file():
        return "this is neither a file nor a folder", _NEEDED
    if not path.stat().st_size:
        return "the file is empty", _NEEDED
    if ending in _VIDEOS:
        return "a video has neither poses nor a calibration", f"write its frames as images into a log folder; {_NEEDED}"
    if ending in _ARCHIVES:
        return "this is an archive", "unpack it, and give the folder"
    if ending in _IMAGES:
        return "this is a single image", _NEEDED
    return "this file is no ROS bag (.bag, .mcap, .db3)", _NEEDED


def _folder(path: Path, is_recording: Callable[[Path], bool], looked_for: str) -> tuple[str, str]:
    """Return a description of the content of a folder, and a hint for the user."""
    inside = sorted(item for item in path.iterdir() if not item.name.startswith("."))
    if not inside:
        return "the folder is empty", _NEEDED
    folders = [item for item in inside if item.is_dir()]
    if known := [str(folder) for folder in folders[:_LOOKED_AT] if is_recording(folder)][:_SHOWN]:
        return "the recordings are in its subfolders", f"give one of them: {', '.join(known)}"
    images = {place: _count_images(place) for place in (path, *folders[:_LOOKED_AT])}
    if count := sum(images.values()):
        missing = [name for name in (CAMERA, f"{RGB}.txt") if not (path / name).exists() and not (path / CAMERAS).exists()]
        where = next(place for place, number in images.items() if number)
        at = "" if where == path else f" in {where.name}/"
        things = ", ".join([*missing, f"and the poses ({ODOMETRY} or {LOCALIZATION})"])
        return f"{count} images{at}, but {things} are missing", "README.md shows a small log that is complete"
    endings = Counter(item.suffix.lower() for item in inside if item.is_file())
    for suffixes, kind, hint in (
        (_VIDEOS, "a video has neither poses nor a calibration", f"write its frames as images; {_NEEDED}"),
        (_ARCHIVES, "its files are archives", "unpack them"),
    ):
        if endings and set(endings) <= suffixes:
            return kind, hint
    names = ", ".join(item.name for item in inside[:_SHOWN]) + (", ..." if len(inside) > _SHOWN else "")
    return f"the folder holds {names}", f"looked for {looked_for}"


def _count_images(folder: Path) -> int:
    return sum(1 for item in folder.iterdir() if item.suffix.lower() in _IMAGES)
