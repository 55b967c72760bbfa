"""Tasks for the engines: they answer, fail, die, hang, and take memory."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from objslam.errors import LogError


def process(argument: int) -> tuple[int, int]:
    """The number of the process, and the argument."""
    return os.getpid(), argument


def die(file: str) -> str:
    """End the process by a signal the first time, as the system does when it is out of memory."""
    if not Path(file).exists():
        Path(file).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def crash(_: object) -> None:
    """End the process as a fault in native code does."""
    os.kill(os.getpid(), signal.SIGSEGV)


def fill(size: int) -> int:
    """Take `size` bytes of memory."""
    return len(b"1" * size)


def hang(_: object) -> None:
    """Never return."""
    signal.pause()


def refuse(argument: str) -> None:
    """Fail as a run fails."""
    raise LogError("no camera", where=argument, hint="add one")
