"""Read the messages of a journal, through all its segments."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.sources.journal.corrections import CORRECTION_READERS, Correction
from objslam.sources.journal.records import Message, decode, is_stop, read_stop
from objslam.sources.journal.segments import contents


def messages(path: Path, ledger: Ledger) -> Iterator[Message]:
    """Yield the messages of a journal in order. Raises LogError if the path is not a journal.

    Damaged records and segments, and records of other versions of objslam, are dropped and counted. If the journal stopped
    before the end of its session, the ledger gets a warning.
    """
    for place, content in contents(path, ledger):
        try:
            if is_stop(content):
                ledger.warn(f"{place}: the journal stopped here: {read_stop(content)}")
            else:
                yield decode(content)
        except LogError as error:  # The checksum is right, so another version of objslam wrote the record.
            ledger.drop(error.message, where=place)


def corrections(file: Path) -> list[Correction]:
    """Return the corrections in the journal `file`. A correction may be later in the file than the keyframe from which
    the correction is valid."""
    found: list[Correction] = []
    for _, content in contents(file, Ledger()):
        if content[:1] in CORRECTION_READERS:
            with suppress(LogError):  # `messages` counts unreadable records.
                message = decode(content)
                assert isinstance(message, Correction)
                found.append(message)
    return found
