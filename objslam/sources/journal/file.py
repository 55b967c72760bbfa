"""Write and read the journal, the file of all messages that a live session accepted.

The file starts with 8 magic bytes. A record holds the length of its content (4 bytes, little endian), the CRC-32 of its
content (4 bytes, little endian) and its content. A message is accepted only when its record is in the kernel's cache, so a
killed process loses no accepted message. The record is on the disk at most `_SYNC_EVERY` later, so a power failure loses at
most the messages of that time.
"""

import fcntl
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Log, Trajectory, label_table
from objslam.errors import LogError, OutputError
from objslam.sources.journal.aside import MAGIC, refusals, set_aside
from objslam.sources.journal.records import (
    CALIBRATION_KIND,
    CalibrationMessage,
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
_HEAD = struct.Struct("<II")
_LONGEST = 1 << 26  # The largest content of a record, bytes. A record that states a greater length counts as damaged.
_SYNC_EVERY = 1.0  # The time between two syncs to the disk, s. With a larger value, a power failure loses more messages.


class Journal:
    """A journal open for writing. Only one process may write it.

    torn: how many bytes of an incomplete record were removed from the end of a resumed journal, else 0.
    """

    def __init__(self, file: Path, resume: bool = False) -> None:
        """Open a new journal. With `resume`, open an existing journal to append to it.

        Without `resume`, an existing journal with messages is renamed first (`set_aside`). With `resume`, an incomplete
        record at the end is removed. Raises OutputError if another session writes the journal or it cannot be opened.
        """
        self.file = file
        if not resume:
            set_aside(file)
        with refusals("open the journal", file):
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
        """Append one message. Raises OutputError if the message is too long or cannot be written."""
        if self._broken is not None:
            raise OutputError(f"cannot write the journal: {self._broken.strerror}", where=str(self.file))
        content = encode(message)
        if len(content) > _LONGEST:
            raise OutputError(f"cannot write the journal: a message of more than {_LONGEST} bytes", where=str(self.file))
        self._append(_HEAD.pack(len(content), zlib.crc32(content)) + content)

    def close(self) -> None:
        """Sync the journal to the disk and close it. Raises OutputError if it cannot be synced."""
        if self._stream < 0:
            return
        self._closed.set()
        self._syncing.join()
        stream, self._stream = self._stream, -1
        try:
            with refusals("write the end of the journal", self.file):
                os.fsync(stream)
        finally:
            os.close(stream)

    def _sync(self) -> None:
        """Sync the journal every `_SYNC_EVERY` until it is closed. A thread runs this, so no message waits for the disk."""
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


def is_journal(path: Path) -> bool:
    """Return whether a path is a journal or a folder with a journal."""
    file = _file(path)
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def messages(path: Path, ledger: Ledger) -> Iterator[Message]:
    """Read the messages of a journal in order. Raises LogError if it is not a journal.

    Records of other versions of objslam are dropped and counted. If a record is damaged or incomplete, the journal is not
    read further, and the rest is dropped and counted once.
    """
    file = _file(path)
    if not is_journal(path):
        raise LogError("this is not a journal", where=str(path))
    with file.open("rb") as stream:
        for content in _records(stream):
            try:
                yield decode(content)
            except LogError as error:  # The checksum is right, so another version of objslam wrote the record.
                ledger.drop(error.message, where=f"{file}:{stream.tell()}")
        rest = file.stat().st_size - stream.tell()
    if rest:
        ledger.drop("torn record at the end of the journal", where=f"{file}, {rest} bytes")


def calibrations(file: Path) -> Iterator[CalibrationMessage]:
    """Read only the calibrations of the journal `file`. A calibration may come later in the file than the keyframe at which
    it takes effect."""
    with file.open("rb") as stream:
        for content in _records(stream):
            if content.startswith(CALIBRATION_KIND):
                with suppress(LogError):  # `messages` drops and counts it too
                    message = decode(content)
                    assert isinstance(message, CalibrationMessage)
                    yield message


def read_journal(path: Path, ledger: Ledger) -> Log:
    """Read a journal as a log, with the stamps that the session gave the messages. Raises LogError if it holds no frames."""
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
    """Yield the contents of the records before the first damaged one. The stream then stands at the end of these records."""
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
        raise OutputError("cannot resume: this file is not a journal", where=str(file), hint="leave out --resume")
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
