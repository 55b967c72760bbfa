"""The journal: what a session accepted, record by record, so that nothing of it is lost when the process is killed.

A file that only grows: 8 bytes that say what it is, then records of length (4 bytes, little endian), CRC-32 (4 bytes) and
content. A record is with the kernel before its message counts, so that a killed process loses none; the disk has it a second
later at the most, so that a power failure loses no more than that.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import struct
import threading
import zlib
from collections.abc import Iterator
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
_LONGEST = 1 << 26  # The longest record, bytes; what claims more is damage.
_SYNC_EVERY = 1.0  # The time between two writes to the disk, s; larger: a power failure loses more.


class Journal:
    """A journal that is written to, by one process at a time; OutputError where the disk refuses.

    torn: bytes of a record that was cut off, which opening it again took away.
    """

    def __init__(self, file: Path, resume: bool = False) -> None:
        """A new journal, or with `resume` the one that is there, without its torn end. OutputError if it is in use.

        Without `resume`, a journal with messages is kept under another name (`set_aside`).
        """
        self.file = file
        if not resume:
            set_aside(file)
        try:
            self._stream = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(f"cannot open the journal: {error.strerror}", where=str(file)) from error
        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._stream)
            raise OutputError("another session writes this journal", where=str(file)) from error
        end = _sound_end(file) if resume else 0
        self.torn = file.stat().st_size - end if resume else 0
        os.ftruncate(self._stream, end)
        os.lseek(self._stream, 0, os.SEEK_END)
        self._end = end
        self._broken: OSError | None = None
        if end == 0:
            self._append(MAGIC)
        self._closed = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name="objslam journal", daemon=True)
        self._syncing.start()

    def write(self, message: Message) -> None:
        """Append one message. When this returns, a killed process has not lost it; a second later, nor has a machine."""
        if self._broken is not None:
            raise OutputError(f"cannot write the journal: {self._broken.strerror}", where=str(self.file))
        content = encode(message)
        if len(content) > _LONGEST:
            raise OutputError(f"cannot write the journal: a message of more than {_LONGEST} bytes", where=str(self.file))
        self._append(_HEAD.pack(len(content), zlib.crc32(content)) + content)

    def close(self) -> None:
        """All of it to the disk; nothing is written any more. OutputError where the disk refuses."""
        if self._stream < 0:
            return
        self._closed.set()
        self._syncing.join()
        stream, self._stream = self._stream, -1
        try:
            os.fsync(stream)
        except OSError as error:
            raise OutputError(f"cannot write the end of the journal: {error.strerror}", where=str(self.file)) from error
        finally:
            os.close(stream)

    def _sync(self) -> None:
        """In a thread of its own: a disk takes milliseconds for it, a slow one far more, and no message is to wait."""
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
                os.ftruncate(self._stream, self._end)  # no half record between whole ones
                os.lseek(self._stream, 0, os.SEEK_END)
            except OSError as worse:  # nothing that came after it could be read
                self._broken = worse
            raise OutputError(f"cannot write the journal: {error.strerror}", where=str(self.file)) from error
        self._end += len(data)


def set_aside(file: Path) -> Path | None:
    """Rename a journal that holds anything to NAME.1.objslam or the next free number; what it is called now, else None.

    OutputError where a session writes it, it is another kind of file, or the disk refuses.
    """
    try:
        if not file.is_file():
            return None
        with file.open("rb") as stream:
            if not MAGIC.startswith(stream.read(len(MAGIC))):
                raise OutputError("this is no journal, and stands where one goes", where=str(file), hint="move it away")
            if file.stat().st_size <= len(MAGIC):
                return None
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            others = (file.with_name(f"{file.stem}.{number}{file.suffix}") for number in itertools.count(1))
            return file.rename(next(other for other in others if not other.exists()))
    except BlockingIOError as error:
        raise OutputError("another session writes this journal", where=str(file)) from error
    except OSError as error:
        raise OutputError(f"cannot set the journal aside: {error.strerror}", where=str(file)) from error


def put_back(aside: Path, file: Path) -> bool:
    """A journal that was set aside, where it was, if the session that took its place never kept anything; whether it is."""
    try:
        if file.is_file() and file.stat().st_size > len(MAGIC):
            return False
        aside.replace(file)
    except OSError as error:
        raise OutputError(f"cannot put {aside} back: {error.strerror}", where=str(file)) from error
    return True


def is_journal(path: Path) -> bool:
    """Whether this is a journal, or a folder with one."""
    file = _file(path)
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def messages(path: Path, ledger: Ledger) -> Iterator[Message]:
    """The messages of a journal in their order. A torn end is dropped and counted; LogError where it is no journal."""
    file = _file(path)
    if not is_journal(path):
        raise LogError("no journal", where=str(path))
    with file.open("rb") as stream:
        for content in _records(stream):
            try:
                yield decode(content)
            except LogError as error:  # whole by its checksum: another version of objslam wrote it
                ledger.drop(error.message, where=f"{file}:{stream.tell()}")
        rest = file.stat().st_size - stream.tell()
    if rest:
        ledger.drop("torn record at the end of the journal", where=f"{file}, {rest} bytes")


def read_journal(path: Path, ledger: Ledger) -> Log:
    """The log that a journal holds: what the session accepted, on its clock. LogError where it holds no frames."""
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
    """The contents of the records before the first torn one.

    Afterwards the stream is at the start of the torn record, or at the end of the file if no record is torn.
    """
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


def _sound_end(file: Path) -> int:
    """The byte position after the last complete record before any torn one; 0 for an empty file.

    OutputError when the file is not a journal.
    """
    size = file.stat().st_size
    if size == 0:
        return 0
    with file.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise OutputError("there is no journal to go on with", where=str(file))
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
