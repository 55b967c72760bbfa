"""Rename the journal of an earlier session, and restore its name if the new session gets no message."""

import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from objslam.errors import OutputError
from objslam.io.atomic_files import try_lock
from objslam.sources.journal.record_format import is_cut_header, read_header
from objslam.sources.journal.segments import holds_messages


def set_aside(file: Path) -> Path | None:
    """Rename the journal `file`, so that a new journal can be written, and return the new path of the old journal.

    The new name has the first free number, for example journal.1.objslam. If there is no journal, or if it has no messages,
    nothing is renamed and None is returned. Raises OutputError if another session writes the journal, if the file is not a
    journal, or if the file cannot be renamed.
    """
    with refusals("set the journal aside", file):
        if not file.is_file():
            return None
        with file.open("rb") as stream:
            header = read_header(stream)
            stream.seek(0)
            if header is None and not is_cut_header(stream.read(64)):
                raise OutputError("this file is not a journal", where=str(file), hint="move it out of the way")
            if not holds_messages(file, header):
                return None
            if not try_lock(stream):
                raise OutputError("another session writes this journal", where=str(file))
            others = (file.with_name(f"{file.stem}.{number}{file.suffix}") for number in itertools.count(1))
            return file.rename(next(other for other in others if not other.exists()))


def put_back(aside: Path, file: Path) -> bool:
    """Rename `aside`, a journal that `set_aside` renamed, back to `file`. Return whether `aside` was renamed.

    Nothing is renamed if `file` is now a journal with messages. Raises OutputError if the journal cannot be renamed.
    """
    with refusals(f"put {aside} back", file):
        if file.is_file():
            with file.open("rb") as stream:
                if holds_messages(file, read_header(stream)):
                    return False
        aside.replace(file)
    return True


def restore_after_kill(file: Path) -> Path | None:
    """Put back the newest journal that was set aside, if `file` is the empty journal of a session that was killed.

    A session sets the earlier journal aside before its own first message. A session that is killed before this message
    leaves an empty journal, and a resumed session would start from nothing. Return the old path of the journal that was put
    back, or None if nothing was renamed. Nothing is renamed if another session has the empty journal open. Raises
    OutputError if the journal cannot be renamed.
    """
    numbered = re.compile(rf"{re.escape(file.stem)}\.[0-9]+{re.escape(file.suffix)}")
    with refusals("put an earlier journal back", file):
        if not file.is_file():
            return None
        with file.open("rb") as stream:
            if not try_lock(stream):
                return None
            header = read_header(stream)
            stream.seek(0)
            empty = is_cut_header(stream.read(64)) if header is None else not holds_messages(file, header)
            kept = [other for other in file.parent.iterdir() if numbered.fullmatch(other.name)]
            if not empty or not kept:
                return None
            newest = max(kept, key=lambda other: other.stat().st_mtime_ns)
            newest.replace(file)
    return newest


@contextmanager
def refusals(action: str, file: Path) -> Iterator[None]:
    """Turn an OSError in the block into the OutputError "cannot ACTION: REASON", which names `file`."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot {action}: {error.strerror}", where=str(file)) from error
