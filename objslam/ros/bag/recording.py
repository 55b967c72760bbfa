"""The files of one recording, found, put in order, and read one after the other."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import yaml

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.io.safe_paths import Inside
from objslam.io.text import read_bytes, reading
from objslam.ros.bag import bag1, mcap, sqlite
from objslam.ros.bag.decompress import ZSTD_MAGIC, CorruptDataError, unpack, unpack_file
from objslam.ros.bag.records import Connection, FileReport, Messages

_READERS = {".bag": bag1.read_bag1, ".mcap": mcap.read_mcap, ".db3": sqlite.read_sqlite}
_MAGIC = {bag1.MAGIC: ".bag", mcap.MAGIC: ".mcap", sqlite.MAGIC: ".db3"}
_FORMATS = {".bag": "ROS 1 bag", ".mcap": "MCAP", ".db3": "ROS 2 sqlite3"}
_METADATA = "metadata.yaml"
_MAX_METADATA = 16 << 20  # The largest metadata.yaml that is read, bytes; chosen to bound the memory.
_MAX_FILE = 256 << 30  # The most bytes that a packed file may unpack to; chosen to bound the disk that it takes.
_MAX_RATIO = 1000  # The most times its own size that a packed file may unpack to; more is no recording.
_SPLIT = re.compile(r"(.*?)[-_]?(\d+)?((?:\.bag|\.mcap|\.db3|\.active|\.zstd)+)")


@dataclass(frozen=True)
class BagFile:
    """One file of a recording: where it lies, its kind (".bag", ".mcap", ".db3"), and whether it is packed as a whole."""

    path: Path
    kind: str
    packed: bool


@dataclass(frozen=True)
class Recording:
    """The files of one recording in their order; expected: the messages that metadata.yaml counts, None without it."""

    name: str
    files: tuple[BagFile, ...]
    expected: int | None = None

    @property
    def format(self) -> str:
        """What kind of files these are, in words."""
        return ", ".join(dict.fromkeys(_FORMATS[file.kind] for file in self.files))


def is_bag(path: Path) -> bool:
    """Whether the path is a bag file, or a folder that holds one."""
    if path.is_dir():
        return any(_kind(file)[0] for file in path.iterdir())
    return path.is_file() and bool(_kind(path)[0])


def find_recording(paths: Path | Sequence[Path], ledger: Ledger) -> Recording:
    """The recording that one or several paths (files, or one folder) name.

    A folder's metadata.yaml, if there is one, says which files belong to it; files that it names outside the folder are
    refused, those that are missing are counted. Without it (a recorder that was killed writes none) all files of the folder
    that differ only in their number are taken. LogError where there is none, or several recordings.
    """
    paths = [paths] if isinstance(paths, Path) else list(paths)
    if not paths:
        raise LogError("no bag is named")
    for path in paths:
        with reading(path):
            path.stat()
    if len(paths) == 1 and paths[0].is_dir():
        with reading(paths[0]):
            return _read_folder(paths[0], ledger)
    files = []
    for path in paths:
        kind, packed = _kind(path)
        if not kind:
            raise LogError("not a ROS bag (.bag, .mcap or .db3)", where=str(path))
        files.append(BagFile(path, kind, packed))
    return Recording(_split(files[0].path)[0] or files[0].path.name, tuple(files))


def read_messages(recording: Recording, wanted: Callable[[Connection], bool], reports: list[FileReport]) -> Messages:
    """The messages of the wanted topics, file by file; `reports` gets a report of each file.

    A file that cannot be read at all is reported and left out. LogError where that is all of them.
    """
    refused: list[LogError] = []
    for file in recording.files:
        report = FileReport(str(file.path))
        reports.append(report)
        with ExitStack() as stack, reading(file.path):
            try:
                path = _unpacked(file, stack, report)
                for connection, stamp, data in _READERS[file.kind](path, report, wanted):
                    if data[:4] == ZSTD_MAGIC:  # no message begins so: rosbag2 packs each on its own where it is told to
                        try:
                            data = unpack(data, "zstd")
                        except CorruptDataError as damaged:
                            report.damage(f"messages that do not unpack ({damaged})", 1)
                            continue
                    yield connection, stamp, data
            except LogError as error:
                report.damage(error.message)
                refused.append(error)
        report.close()
    if refused and len(refused) == len(recording.files):
        raise refused[0]
    if recording.expected is not None and len(reports) == len(recording.files):
        gone = recording.expected - sum(report.messages + report.lost for report in reports)
        if gone > 0:
            reports.append(FileReport(_METADATA, 0, gone, problems=[f"{_METADATA} counts {recording.expected} messages"]))


def _kind(path: Path) -> tuple[str, bool]:
    """The kind of a file ("" if it is no bag) and whether it is packed: by its name, else by its first bytes."""
    suffixes = [suffix for suffix in path.suffixes if suffix != ".active"]
    packed = bool(suffixes) and suffixes[-1] == ".zstd"
    suffix = suffixes[-2 if packed else -1] if len(suffixes) > packed else ""
    if suffix in _READERS:
        return (suffix, packed) if path.is_file() else ("", False)
    if packed or not path.is_file() or suffix in (".db3-wal", ".db3-shm"):
        return "", False
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError:
        return "", False
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), ""), False


def _split(path: Path) -> tuple[str, int]:
    """A file's name without its number and endings, and the number (-1 without one)."""
    match = _SPLIT.fullmatch(path.name)
    return (match[1], int(match[2] or -1)) if match else (path.name, -1)


def _read_folder(folder: Path, ledger: Ledger) -> Recording:
    inside = Inside(folder)
    here = []
    for file in sorted(folder.iterdir(), key=_split):
        kind, packed = _kind(file)
        reason = inside.reason_against(file) if kind else None
        if reason is not None:
            ledger.drop(f"bag file that {reason}", where=str(file))
        elif kind:
            here.append(BagFile(file, kind, packed))
    metadata = _read_metadata(folder / _METADATA, ledger) if (folder / _METADATA).exists() else {}
    listed = _listed(metadata, [file.path.name for file in here], ledger)
    if listed:
        unlisted = [file.path.name for file in here if file.path.name not in listed]
        if unlisted:
            ledger.warn(f"{folder}: {_METADATA} does not list {', '.join(unlisted[:5])}: left out")
        here = [file for name in listed for file in here if file.path.name == name]
    groups = {(_split(file.path)[0], file.kind) for file in here}
    if not here:
        raise LogError("no bag file in it", where=str(folder))
    if not listed and len(groups) > 1:
        names = ", ".join(file.path.name for file in here[:8])
        raise LogError(f"several recordings: {names}", where=str(folder), hint="name one of them")
    count = metadata.get("message_count")
    return Recording(folder.resolve().name, tuple(here), count if type(count) is int and count >= 0 else None)


def _read_metadata(file: Path, ledger: Ledger) -> dict[str, Any]:
    try:
        if file.stat().st_size > _MAX_METADATA:
            raise LogError(f"larger than {_MAX_METADATA >> 20} MiB", where=str(file))
        data = yaml.safe_load(read_bytes(file).decode("utf-8", "replace"))
        return dict(data["rosbag2_bagfile_information"])
    except (LogError, yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError) as error:
        reason = error.message if isinstance(error, LogError) else "not what rosbag2 writes"
        ledger.warn(f"{file}: {reason}: left out, the files of the folder are read as they are")
        return {}


def _listed(metadata: dict[str, Any], here: list[str], ledger: Ledger) -> list[str]:
    """The names of the files that the metadata list and that are in the folder; old ones name them with their folder."""
    names = []
    given = metadata.get("relative_file_paths")
    for entry in given if isinstance(given, list) else []:
        path = PurePath(str(entry))
        if path.is_absolute() or ".." in path.parts:
            ledger.drop(f"bag file that {_METADATA} names outside of its folder", where=str(entry)[:200])
        elif path.name not in here:
            ledger.drop(f"bag file that {_METADATA} lists and that is missing", where=str(entry)[:200])
        else:
            names.append(path.name)
    return names


def _unpacked(file: BagFile, stack: ExitStack, report: FileReport) -> Path:
    if not file.packed:
        return file.path
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="objslam_bag_"))
    target = Path(folder, "bag" + file.kind)
    limit = min(_MAX_FILE, max(1 << 30, _MAX_RATIO * file.path.stat().st_size))
    problem = unpack_file(file.path, target, limit)
    if problem:
        report.damage(problem)
    return target
