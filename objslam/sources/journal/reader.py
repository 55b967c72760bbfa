"""Read the messages of a journal, through all its segments."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from objslam.core.diagnostics import Ledger
from objslam.errors import LogError
from objslam.sources.journal.records import CALIBRATION_KIND, CalibrationMessage, Message, decode, is_stop, read_stop
from objslam.sources.journal.segments import contents


def messages(path: Path, ledger: Ledger) -> Iterator[Message]:
    """Read the messages of a journal in order. Raises LogError if it is not a journal.

    Damaged records and segments, and records of other versions of objslam, are dropped and counted. If a session had to stop
    the journal before its own end, the ledger gets a warning.
    """
    for place, content in contents(path, ledger):
        try:
            if is_stop(content):
                ledger.warn(f"{place}: the journal stopped here: {read_stop(content)}")
            else:
                yield decode(content)
        except LogError as error:  # The checksum is right, so another version of objslam wrote the record.
            ledger.drop(error.message, where=place)


def calibrations(file: Path) -> Iterator[CalibrationMessage]:
    """Read only the calibrations of the journal `file`. A calibration may come later in the file than the keyframe at which
    it takes effect."""
    for _, content in contents(file, Ledger()):
        if content.startswith(CALIBRATION_KIND):
            with suppress(LogError):  # `messages` counts unreadable records.
                message = decode(content)
                assert isinstance(message, CalibrationMessage)
                yield message
