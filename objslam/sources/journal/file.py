"""Write and read the journal, the file of all messages that a live session accepted.

The file starts with 8 magic bytes. Each record is its length (4 bytes, little endian), CRC-32 (4 bytes) and content.
A record is in the kernel's cache before its message counts, so a killed process loses no message. It is on the disk at most
`_SYNC_EVERY` later, so a power failure loses at most the messages of that time.
"""

import fcntl
import itertools
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Log, Trajectory, label_table
from objslam.errors import LogError, OutputError
from objslam.sources.journal.records import (
    CameraMessage,
    FrameMessage,
    HeldMounts,
    Message,
    MountMessage,
    PoseMessage,
    decode,
    encode,
)

NAME = "journal.objslam"
MAGIC = b"OBJSLAM1"
_HEAD = struct.Struct("<II")
_LONGEST = 1 << 26  # The longest record, bytes. A length above it is taken as damage.
_SYNC_EVERY = 1.0  # The time between two syncs to the disk, s. With a larger value, a power failure loses more messages.


class Journal:
    """A journal open for writing. Only one process may write it.

    torn: the number of bytes of an incomplete last record, which `resume` removed.
    """

    def __init__(self, file: Path, resume: bool = False) -> None:
        """Open a new journal, or with `resume` append to the existing journal after removing its torn end.

        Without `resume`, an existing journal with messages is renamed first (`set_aside`).
        Raises OutputError if another session writes the journal or the disk refuses.
        """
        self.file = file
        if not resume:
            set_aside(file)
        with _refusals("open the journal", file):
            self._stream = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._stream)
            raise OutputError("another session writes this journal", where=str(file)) from error
        self._end = _end_of_records(file) if resume else 0
        self.torn = file.stat().st_size - self._end if resume else 0
        os.ftruncate(self._stream, self._end)
        os.lseek(self._stream, 0, os.SEEK_END)
        self._broken: OSError | None = None
        if self._end == 0:
            self._append(MAGIC)
        self._closed = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name="objslam journal", daemon=True)
        self._syncing.start()

    def write(self, message: Message) -> None:
        """Append one message. Raises OutputError if the message is too long or the disk refuses."""
        if self._broken is not None:
            raise OutputError(f"cannot write the journal: {self._broken.strerror}", where=str(self.file))
        content = encode(message)
        if len(content) > _LONGEST:
            raise OutputError(f"cannot write the journal: a message of more than {_LONGEST} bytes", where=str(self.file))
        self._append(_HEAD.pack(len(content), zlib.crc32(content)) + content)

    def close(self) -> None:
        """Sync the journal to the disk and close it. Raises OutputError if the disk refuses."""
        if self._stream < 0:
            return
        self._closed.set()
        self._syncing.join()
        stream, self._stream = self._stream, -1
        try:
            with _refusals("write the end of the journal", self.file):
                os.fsync(stream)
        finally:
            os.close(stream)

    def _sync(self) -> None:
        """Sync in a thread of its own, so that no message waits for the disk."""
        synced = 0
        while not self._closed.wait(_SYNC_EVERY):
            end = self._end
            if end != synced:
                try:
                    os.fdatasync(self._stream)
                except OSError as error:
                    self._broken = error
                    return
                synced = end

    def _append(self, data: bytes) -> None:
        try:
            done = 0
            while done < len(data):
                done += os.write(self._stream, data[done:])
        except OSError as error:
            try:
                os.ftruncate(self._stream, self._end)  # Remove the incomplete record, so that later records stay readable.
                os.lseek(self._stream, 0, os.SEEK_END)
            except OSError as worse:
                self._broken = worse
            raise OutputError(f"cannot write the journal: {error.strerror}", where=str(self.file)) from error
        self._end += len(data)


def set_aside(file: Path) -> Path | None:
    """Rename a journal with messages to NAME.1.objslam, or to the next free number, and return the new path.

    Returns None if there is no journal, or none with messages.
    Raises OutputError if another session writes the journal, the file is no journal, or the disk refuses.
    """
    with _refusals("set the journal aside", file):
        if not file.is_file():
            return None
        with file.open("rb") as stream:
            if not MAGIC.startswith(stream.read(len(MAGIC))):
                raise OutputError("this file is not a journal", where=str(file), hint="move it out of the way")
            if file.stat().st_size <= len(MAGIC):
                return None
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise OutputError("another session writes this journal", where=str(file)) from error
            others = (file.with_name(f"{file.stem}.{number}{file.suffix}") for number in itertools.count(1))
            return file.rename(next(other for other in others if not other.exists()))


def put_back(aside: Path, file: Path) -> bool:
    """Rename a journal from `set_aside` back, unless the new journal has messages. Returns whether it was renamed."""
    with _refusals(f"put {aside} back", file):
        if file.is_file() and file.stat().st_size > len(MAGIC):
            return False
        aside.replace(file)
    return True


@contextmanager
def _refusals(action: str, file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot {action}: {error.strerror}", where=str(file)) from error


def is_journal(path: Path) -> bool:
    """Return whether a path is a journal or a folder with a journal."""
    file = _file(path)
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def messages(path: Path, ledger: Ledger) -> Iterator[Message]:
    """Read the messages of a journal in order. A torn end is dropped and counted. Raises LogError if it is no journal."""
    file = _file(path)
    if not is_journal(path):
        raise LogError("this is no journal", where=str(path))
    with file.open("rb") as stream:
        for content in _records(stream):
            try:
                yield decode(content)
            except LogError as error:  # The checksum is right, so another version of objslam wrote the record.
                ledger.drop(error.message, where=f"{file}:{stream.tell()}")
        rest = file.stat().st_size - stream.tell()
    if rest:
        ledger.drop("torn record at the end of the journal", where=f"{file}, {rest} bytes")


def read_journal(path: Path, ledger: Ledger) -> Log:
    """Read a journal as a log, with stamps on the session's clock. Raises LogError if the journal holds no frames."""
    poses: dict[str, list[PoseMessage]] = {"odometry": [], "localization": []}
    cameras: dict[str, Camera] = {}
    frames: dict[str, list[FrameMessage]] = {}
    mounts: dict[str, HeldMounts] = {}
    for message in messages(path, ledger):
        if isinstance(message, PoseMessage):
            poses[message.path].append(message)
        elif isinstance(message, CameraMessage):
            cameras[message.camera.name] = message.camera
        elif isinstance(message, FrameMessage):
            frames.setdefault(message.camera, []).append(message)
        elif isinstance(message, MountMessage):
            mounts.setdefault(message.camera, HeldMounts()).add(message)
    if not frames:
        raise LogError("the journal holds no frames", where=str(path))
    return Log(
        name=_file(path).resolve().parent.name,
        cameras=tuple(_camera_log(camera, frames.get(name, []), mounts.get(name)) for name, camera in cameras.items()),
        odometry=_trajectory(poses["odometry"]),
        localization=_trajectory(poses["localization"]),
    )


def _file(path: Path) -> Path:
    return path / NAME if path.is_dir() else path


def _records(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the content of each record. Stops with the stream at the start of the first torn record or the file's end."""
    stream.seek(len(MAGIC))
    while True:
        start = stream.tell()
        head = stream.read(_HEAD.size)
        if len(head) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            content = stream.read(length) if length <= _LONGEST else b""
            if len(content) == length and zlib.crc32(content) == checksum:
                yield content
                continue
        stream.seek(start)
        return


def _end_of_records(file: Path) -> int:
    if file.stat().st_size == 0:
        return 0
    if not is_journal(file):
        raise OutputError("cannot resume: this file is no journal", where=str(file), hint="leave out --resume")
    with file.open("rb") as stream:
        for _ in _records(stream):
            pass
        return stream.tell()


def _trajectory(found: list[PoseMessage]) -> Trajectory | None:
    if not found:
        return None
    stamps, poses = np.array([m.stamp for m in found]), np.array([m.pose for m in found])
    first = np.append(True, np.diff(stamps) > 0)
    return Trajectory(stamps[first], poses[first])


def _camera_log(camera: Camera, frames: list[FrameMessage], mounts: HeldMounts | None) -> CameraLog:
    frames = sorted(frames, key=lambda frame: frame.stamp)
    stamps = np.array([frame.stamp for frame in frames])
    names, label = label_table([name for frame in frames for name in frame.labels])
    detections = Detections(
        frame_stamps=stamps,
        frame=np.repeat(np.arange(len(frames)), [len(frame) for frame in frames]),
        boxes=np.concatenate([np.zeros((0, 4)), *(frame.boxes for frame in frames)]),
        label=label,
        scores=np.concatenate([np.zeros(0), *(frame.scores for frame in frames)]),
        depths=np.concatenate([np.zeros(0), *(frame.depths for frame in frames)]),
        track_ids=np.concatenate([np.zeros(0, dtype=np.int64), *(frame.track_ids for frame in frames)]),
        label_names=names,
        whole=bool(frames) and all(frame.whole for frame in frames),
    )
    if mounts is None:
        return CameraLog(camera, detections)
    held = np.array([mounts.at(stamp, camera) for stamp in stamps.tolist()]).reshape(-1, 4, 4)
    return CameraLog(camera, detections, mount=Trajectory(stamps, held))
