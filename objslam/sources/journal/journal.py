"""Write the journal of a live session. Its files have all messages that the session accepted.

A message is accepted only when its record is in the kernel's cache, so a killed process loses no accepted message. The
record is on the disk about 1 s later (`_SYNC_EVERY`), so a power failure loses the messages of about 1 s. If the disk is
nearly full or fails, or the file is deleted, the journal warns and stops. The session goes on without the journal.
"""

import os
import secrets
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from objslam.errors import OutputError, one_line
from objslam.io.atomic_files import try_lock
from objslam.io.folders import remove_leftovers
from objslam.io.threads import start_thread
from objslam.sources.journal.aside import refusals, set_aside
from objslam.sources.journal.record_format import (
    LONGEST,
    Header,
    is_cut_header,
    pack_header,
    pack_record,
    read_header,
    records,
)
from objslam.sources.journal.records import Message, encode, encode_stop
from objslam.sources.journal.segments import compress, identity_of, new_file, seal, uncompressed_segments

_SYNC_EVERY = 1.0  # The time between two syncs to the disk, s. With a larger value, a power failure loses more messages.
_EARLY = 2.0
"""The free space at which a warning comes, as a multiple of the free space at which the journal stops. A larger value warns
earlier."""
_SMALL = 0.02
"""The largest share of the disk that the journal leaves free. With a larger share, the journal stops earlier on a small
disk."""
_MB = 1_000_000


class Journal:
    """A journal that is open for writing. Only one process may write to it.

    torn: the number of bytes after the last undamaged record that were removed from a resumed journal. It is 0 for a new
    journal. stopped: the reason why the journal stopped. It is None as long as messages are written.
    """

    def __init__(
        self,
        file: Path,
        resume: bool = False,
        *,
        segment: int = 64 * _MB,
        min_free: int = 200 * _MB,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Open a new journal. With `resume`, open an existing journal to append to it.

        Without `resume`, an existing journal with messages is renamed first (`set_aside`). With `resume`, the bytes after
        the last undamaged record are removed. segment: the size at which a segment is sealed and compressed, bytes.
        min_free: the free space of the disk at which the journal stops, bytes. The limit is smaller on a small disk
        (`_SMALL`). warn: the function that is called with each warning, from any thread. Raises OutputError if another
        session writes the journal, if the file is not a journal, or if the file cannot be opened.
        """
        self.file, self._segment, self._warn = file, segment, warn
        self._min_free = min_free
        if not resume:
            set_aside(file)
        with refusals("open the journal", file):
            remove_leftovers(file)
            self._stream = _locked(file)
        try:
            with refusals("read the journal", file):
                header, self._end, size = _existing(file) if resume else (None, 0, 0)
                self.torn = size - self._end
                os.ftruncate(self._stream, self._end)
                os.lseek(self._stream, 0, os.SEEK_END)
        except OutputError:
            os.close(self._stream)
            raise
        self.stopped: str | None = None
        self._lock = threading.Lock()
        self._announced = False
        if header is None:
            identity = secrets.token_bytes(8)
            data = pack_header(identity, 1)
            header = Header(2, len(data), identity)
            self._append(data)
        self._header = header
        self._closed = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name="objslam journal", daemon=True)
        start_thread(self._syncing)

    def write(self, message: Message) -> None:
        """Append one message, or do nothing if the journal has stopped. Raises OutputError if the message is too long."""
        content = encode(message)
        if len(content) > LONGEST:
            raise OutputError(f"cannot write the journal: a message of more than {LONGEST} bytes", where=str(self.file))
        with self._lock:
            if self.stopped is None:
                self._append(pack_record(self._header.version, content))

    def close(self) -> None:
        """Sync the journal to the disk and close it. Raises OutputError if the sync fails."""
        if self._stream < 0:
            return
        self._closed.set()
        self._syncing.join()
        stream, self._stream = self._stream, -1
        try:
            with refusals("write the end of the journal", self.file):
                if self.stopped is None:
                    os.fsync(stream)
        finally:
            os.close(stream)

    def _sync(self) -> None:
        """Sync the journal every `_SYNC_EVERY` until it is closed, watch the disk, and seal and compress full segments.

        This method runs in its own thread, so no message waits for the disk.
        """
        self._compress()
        synced = 0
        sealed_at = self._segment
        while self.stopped is None and not self._closed.wait(_SYNC_EVERY):
            end = self._end
            try:
                if end != synced:
                    os.fdatasync(self._stream)
                    synced = end
                self._watch()
            except OSError as error:
                with self._lock:
                    self._stop(error.strerror or one_line(error))
            if self.stopped is None and end >= sealed_at:
                sealed_at = self._segment if self._seal() else end + self._segment
                synced = 0

    def _watch(self) -> None:
        """Stop the journal if the disk is nearly full or the file was deleted. Warn once when the disk begins to fill."""
        if os.fstat(self._stream).st_nlink == 0:
            with self._lock:
                self._stop("the file was deleted")
            return
        disk = shutil.disk_usage(self.file.parent)
        least = min(self._min_free, int(_SMALL * disk.total))
        if disk.free < least:
            with self._lock:
                self._stop(f"only {disk.free / _MB:.1f} MB of the disk are free")
        elif disk.free < _EARLY * least and not self._announced:
            self._announced = True
            left, limit = disk.free / _MB, least / _MB
            self._warn(f"{self.file}: {left:.1f} MB of the disk are free, the journal stops at {limit:.1f} MB")

    def _seal(self) -> bool:
        """Begin a new segment, and compress the full one. Return False if the segment cannot be created or synced."""
        try:
            identity, number = identity_of(self.file, self._header), self._header.number
            fresh, stream = new_file(self.file, identity, number + 1)
            try:
                with self._lock:
                    seal(self.file, identity, number, fresh)
                    old, self._stream = self._stream, stream
                    size = os.lseek(stream, 0, os.SEEK_END)
                    self._header, self._end = Header(2, size, identity, number + 1), size
            except OSError:
                os.close(stream)
                fresh.unlink(missing_ok=True)
                raise
            try:
                os.fsync(old)
            finally:
                os.close(old)
        except OSError as error:
            self._warn(f"{self.file}: cannot begin a new segment: {error.strerror or one_line(error)}")
            return False
        self._compress()
        return True

    def _compress(self) -> None:
        """Compress the earlier segments that are uncompressed. Warn if this fails, because they can still be read."""
        try:
            for full in uncompressed_segments(self.file, identity_of(self.file, self._header), self._header.number):
                compress(full)
        except OSError as error:
            self._warn(f"{self.file}: cannot compress an earlier segment: {error.strerror or one_line(error)}")

    def _append(self, data: bytes) -> None:
        try:
            done = 0
            while done < len(data):
                done += os.write(self._stream, data[done:])
        except OSError as error:
            self._stop(error.strerror or one_line(error))
            return
        self._end += len(data)

    def _stop(self, reason: str) -> None:
        """Stop writing, and warn with the reason. If possible, remove an incomplete record and write the reason there."""
        if self.stopped is not None:
            return
        self.stopped = reason
        with suppress(OSError):  # If this fails, a reader drops the incomplete record.
            os.ftruncate(self._stream, self._end)
            os.lseek(self._stream, 0, os.SEEK_END)
            os.write(self._stream, pack_record(self._header.version, encode_stop(reason)))
            os.fdatasync(self._stream)
        self._warn(f"{self.file}: the journal stops, and the session goes on without it: {reason}")


def _locked(file: Path) -> int:
    """Open and lock a journal, and return its file descriptor. If there is no journal, make an empty file.

    Raises OutputError if another session writes the journal.
    """
    while True:
        stream = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if not try_lock(stream):
                raise OutputError("another session writes this journal", where=str(file))
            if os.path.samestat(os.fstat(stream), os.stat(file)):  # noqa: PTH116 - the path against the open file
                return stream
        except (OSError, OutputError):
            os.close(stream)
            raise
        os.close(stream)  # A new segment replaced this file before it was locked.


def _existing(file: Path) -> tuple[Header | None, int, int]:
    """Return the header of a journal, the end of its last undamaged record, bytes, and the size of the file, bytes.

    If the file is cut off in its header, the header is None and the end is 0. Raises OutputError if the file is no journal.
    """
    size = file.stat().st_size
    with file.open("rb") as stream:
        header = read_header(stream)
        if header is None:
            stream.seek(0)
            if is_cut_header(stream.read(64)):
                return None, 0, size
            raise OutputError("cannot resume: this file is not a journal", where=str(file), hint="leave out --resume")
        end = header.size
        for record in records(stream, header):
            end = record.end
    return header, end, size
