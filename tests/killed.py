"""Work in a process of its own that may be killed, for the tests of what is left on the disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from objslam.errors import ObjslamError


def in_child(work: Callable[[], None]) -> int:
    """The exit code of a forked process that does the work: 0 done, 3 an ObjslamError, 4 any other error, 9 killed."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except ObjslamError:
            os._exit(3)
        finally:
            os._exit(4)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(step: int, work: Callable[[], None]) -> Callable[[], None]:
    """The work, with the process killed right before its step-th call that touches the disk for good."""

    def run() -> None:
        left = step

        def count(call: Callable[..., object]) -> Callable[..., object]:
            def counted(*args: object, **kwargs: object) -> object:
                nonlocal left
                left -= 1
                if left < 0:
                    os._exit(9)
                return call(*args, **kwargs)

            return counted

        os.fsync, os.rename, os.replace, os.unlink = map(count, (os.fsync, os.rename, os.replace, os.unlink))  # type: ignore[assignment]
        work()

    return run


def contents(out: Path) -> dict[str, bytes]:
    """What the files of a folder hold, by name; folders in it, such as what is staged, are left out."""
    return {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
