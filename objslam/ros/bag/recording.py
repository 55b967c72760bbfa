"""Find the files of one recording, sort them, and read their messages in sequence."""

import re
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
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
from objslam.ros.bag.records import FileReport, Messages, Wanted

_FORMATS = {
    ".bag": ("ROS 1 bag", bag1.MAGIC, bag1.read_bag1),
    ".mcap": ("MCAP", mcap.MAGIC, mcap.read_mcap),
    ".db3": ("ROS 2 sqlite3", sqlite.MAGIC, sqlite.read_sqlite),
}
_METADATA = "metadata.yaml"
_MAX_METADATA = 16 << 20  # The size limit of metadata.yaml, bytes. The limit bounds memory.
_MAX_FILE = 256 << 30  # The size limit of an unpacked file, bytes. The limit bounds disk use.
_MAX_RATIO = 1000
"""The largest allowed ratio of a file's unpacked size to its packed size. No recording has a larger ratio. An unpacked size
of up to 1 GiB is always allowed."""
_SPLIT = re.compile(r"(.*?)[-_]?(\d+)?((?:\.bag|\.mcap|\.db3|\.active|\.zstd)+)")


@dataclass(frozen=True)
class BagFile:
    """One file of a recording. kind: ".bag", ".mcap" or ".db3". packed: whether the whole file is compressed."""

    path: Path
    kind: str
    packed: bool


@dataclass(frozen=True)
class Recording:
    """The files of one recording in order. expected: the message count in metadata.yaml, or None if it is unknown."""

    name: str
    files: tuple[BagFile, ...]
    expected: int | None = None

    @property
    def format(self) -> str:
        """The names of the file formats, separated by commas."""
        return ", ".join(dict.fromkeys(_FORMATS[file.kind][0] for file in self.files))


def is_bag(path: Path) -> bool:
    """Return whether the path is a bag file, or a folder that contains a bag file."""
    return any(_bag_file(file) for file in (path.iterdir() if path.is_dir() else [path]))


def find_recording(paths: Path | Sequence[Path], ledger: Ledger) -> Recording:
    """Find the recording in one or several files, or in one folder.

    Several files are read in the given order. The metadata.yaml of a folder lists its files. Listed files that are missing
    or outside the folder are counted as drops. Files that metadata.yaml does not list are left out with a warning. A killed
    recorder writes no metadata.yaml. The names of the files in such a folder may differ only in the number before the
    suffix. Raises LogError if there is no recording, or if a folder has more than one recording.
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
        file = _bag_file(path)
        if file is None:
            raise LogError("not a ROS bag (.bag, .mcap or .db3)", where=str(path))
        files.append(file)
    return Recording(_split(files[0].path)[0] or files[0].path.name, tuple(files))


def read_messages(recording: Recording, wanted: Wanted, reports: list[FileReport]) -> Messages:
    """Yield the messages of the wanted topics, file by file, and append a report on each file to `reports`.

    An unreadable file is reported and skipped. If metadata.yaml counts more messages than the files have, a last report
    counts the missing messages. Raises LogError if no file can be read.
    """
    refused: list[LogError] = []
    for file in recording.files:
        report = FileReport(str(file.path))
        reports.append(report)
        with ExitStack() as stack, reading(file.path):
            try:
                path = _unpacked(file, stack, report)
                for connection, stamp, data in _FORMATS[file.kind][2](path, report, wanted):
                    if data[:4] == ZSTD_MAGIC:  # rosbag2 can compress each message separately.
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
            reports.append(FileReport(recording.name, 0, gone, recording.expected, of_folder=True))


def _bag_file(path: Path) -> BagFile | None:
    """Return the bag file at a path, or None if the file is no bag. If the suffix is unknown, the first bytes decide."""
    suffixes = [suffix for suffix in path.suffixes if suffix != ".active"]
    packed = bool(suffixes) and suffixes[-1] == ".zstd"
    suffix = suffixes[-2 if packed else -1] if len(suffixes) > packed else ""
    if not path.is_file():
        return None
    if suffix in _FORMATS:
        return BagFile(path, suffix, packed)
    if packed or suffix in (".db3-wal", ".db3-shm"):
        return None
    head = b""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(16)
    return next((BagFile(path, kind, False) for kind, (_, magic, _) in _FORMATS.items() if head.startswith(magic)), None)


def _split(path: Path) -> tuple[str, int]:
    """Return a file name without its number and suffixes, and this number. The number is -1 if the name has no number."""
    match = _SPLIT.fullmatch(path.name)
    return (match[1], int(match[2] or -1)) if match else (path.name, -1)


def _read_folder(folder: Path, ledger: Ledger) -> Recording:
    inside = Inside(folder)
    here = []
    for path in sorted(folder.iterdir(), key=_split):
        if (bag := _bag_file(path)) is None:
            continue
        if (reason := inside.reason_against(path)) is not None:
            ledger.drop(f"bag file that {reason}", where=str(path))
        else:
            here.append(bag)
    metadata = _read_metadata(folder / _METADATA, ledger) if (folder / _METADATA).exists() else {}
    listed = _listed(metadata, [file.path.name for file in here], ledger)
    if listed:
        unlisted = [file.path.name for file in here if file.path.name not in listed]
        if unlisted:
            ledger.warn(f"{folder}: {_METADATA} does not list {', '.join(unlisted[:5])}: left out")
        here = [file for name in listed for file in here if file.path.name == name]
    if not here:
        raise LogError("no bag file in it", where=str(folder))
    if not listed and len({(_split(file.path)[0], file.kind) for file in here}) > 1:
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
        ledger.warn(f"{file}: {reason}: left out, so all bag files of the folder are read")
        return {}


def _listed(metadata: dict[str, Any], here: list[str], ledger: Ledger) -> list[str]:
    """Return the file names that the metadata list and `here` contains. Only the file name of a listed path counts,
    because old metadata files also name the folder."""
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
    if problem := unpack_file(file.path, target, limit):
        report.damage(problem)
    return target
