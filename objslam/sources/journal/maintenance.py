"""Check and repair the files of a journal, and write its messages as JSON lines."""

import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import quaternion
from objslam.errors import LogError, OutputError
from objslam.io.atomic_files import disk_errors, try_lock
from objslam.io.camera_yaml import camera_keys
from objslam.io.folders import remove_leftovers, temporary_name
from objslam.sources.journal.reader import messages
from objslam.sources.journal.record_format import pack_header, pack_record, records
from objslam.sources.journal.records import CameraMessage, FrameMessage, Message, MountMessage, PoseMessage, decode, is_stop
from objslam.sources.journal.segments import Segment, compress, identity_of, journal_file, segments, uncompressed_segments


@dataclass(frozen=True)
class Check:
    """The state of a segment. format: 1 or 2, or 0 if the header cannot be read. size: bytes, 0 if the file is missing.

    records: the number of undamaged records. unknown: the number of undamaged records that this version of objslam cannot
    read. damaged: the number of bytes that belong to no undamaged record. start, end: the least and the greatest stamp, s,
    None if no record has a stamp.
    """

    path: Path
    format: int
    size: int
    records: int = 0
    unknown: int = 0
    damaged: int = 0
    start: float | None = None
    end: float | None = None

    @property
    def sound(self) -> bool:
        return self.format > 0 and not self.damaged


def verify(path: Path) -> list[Check]:
    """Return the state of each segment of a journal, including missing ones. Raises LogError if the path is no journal."""
    return [_check(segment) for segment in segments(path)]


def repair(path: Path) -> list[Path]:
    """Rewrite each damaged segment without its damage, and compress the earlier segments that are uncompressed.

    Return the files that were written. The damaged file is kept beside the new one, with ".damaged" after its name. Records
    that this version of objslam cannot read are kept. A segment that is missing or has no header cannot be repaired. Raises
    LogError if the path is not a journal, and OutputError if a session writes the journal or a file cannot be written.
    """
    file = journal_file(path)
    found = segments(path)
    with disk_errors(file), _locked(file):
        remove_leftovers(file)
        made = [_without_damage(segment) for segment in found if segment.header is not None and not _check(segment).sound]
        last = found[-1].header
        assert last is not None
        made += [compress(full) for full in uncompressed_segments(file, identity_of(file, last), last.number)]
    return [one for one in made if one.exists()]  # A rewritten segment that was then compressed has another name.


def json_lines(path: Path, ledger: Ledger, left_out: Counter[str]) -> Iterator[str]:
    """Yield the messages of a journal as lines for `objslam live stdin`, with the stamps of the session.

    left_out: gets the number of messages that have no such line, by kind. The kinds are "note" (`NoteMessage`), and
    "calibration", "bodies", "association" and "names" (corrections). Raises LogError if the path is not a journal.
    """
    for message in messages(path, ledger):
        row = _row(message)
        if row is None:
            left_out[type(message).__name__.removesuffix("Message").lower()] += 1
        else:
            yield json.dumps(row)


def _check(segment: Segment) -> Check:
    size = segment.path.stat().st_size if segment.path.exists() else 0
    if segment.header is None:
        return Check(segment.path, 0, size)
    count = unknown = good = 0
    stamps: list[float] = []
    with segment.open() as stream:
        for record in records(stream, segment.header):
            count, good = count + 1, good + record.end - record.start
            try:
                stamp = None if is_stop(record.content) else getattr(decode(record.content), "stamp", None)
            except LogError:
                unknown += 1
                continue
            if stamp is not None:
                stamps = [min([stamp, *stamps]), max([stamp, *stamps])]
        while stream.read(1 << 20):
            pass
        damaged = stream.tell() - segment.header.size - good
    first, last = stamps or (None, None)
    return Check(segment.path, segment.header.version, size, count, unknown, damaged, first, last)


def _without_damage(segment: Segment) -> Path:
    """Replace a segment by an uncompressed file with its undamaged records, and return this file."""
    header = segment.header
    assert header is not None
    old, new = segment.path, segment.path.with_name(segment.path.name.removesuffix(".zst"))
    temporary = new.with_name(temporary_name(new))
    remove_leftovers(new)
    try:
        with segment.open() as stream, temporary.open("wb") as target:
            target.write(pack_header(header.identity, header.number) if header.version > 1 else b"OBJSLAM1")
            for record in records(stream, header):
                target.write(pack_record(header.version, record.content))
            target.flush()
            os.fsync(target.fileno())
        shutil.copyfile(old, old.with_name(f"{old.name}.damaged"))
        temporary.replace(new)
    finally:
        temporary.unlink(missing_ok=True)
    if old != new:
        old.unlink()
    return new


@contextmanager
def _locked(file: Path) -> Iterator[None]:
    with file.open("rb") as stream:
        if not try_lock(stream):
            raise OutputError("a session writes this journal", where=str(file), hint="end it first")
        yield


def _row(message: Message) -> dict[str, Any] | None:
    if isinstance(message, CameraMessage):
        return {"type": "camera", "name": message.camera.name, **camera_keys(message.camera)}
    if isinstance(message, PoseMessage | MountMessage):
        xyzw = quaternion(message.pose[None])[0].tolist()
        kind = {"type": message.path} if isinstance(message, PoseMessage) else {"type": "mount", "camera": message.camera}
        return {**kind, "stamp": message.stamp, "translation": message.pose[:3, 3].tolist(), "rotation_xyzw": xyzw}
    if isinstance(message, FrameMessage):
        depths = [depth if depth == depth else None for depth in message.depths.tolist()]
        tracks = [track if track >= 0 else None for track in message.track_ids.tolist()]
        columns = {"boxes": message.boxes.tolist(), "labels": list(message.labels), "scores": message.scores.tolist()}
        frame = {"type": "detections", "camera": message.camera, "stamp": message.stamp, **columns}
        return {**frame, "depths": depths, "track_ids": tracks, **({"whole": True} if message.whole else {})}
    return None
