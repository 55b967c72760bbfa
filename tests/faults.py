"""Faults of the disk, injected into a forked process: a kill, or an error, at the nth call that changes the disk.

The child replaces the functions of `os` and `open` before it works, so no new interpreter starts for a fault. What a library
writes without Python (a recording, a picture) is not seen here; a limit on the size of a file or a small disk reaches that.
"""

from __future__ import annotations

import builtins
import errno
import io
import mmap
import os
import signal
import stat
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from waiting import LIMIT

from objslam.errors import ObjslamError

SPACE = frozenset({"write", "open", "mkdir", "link"})
"""The calls that take space on the disk. The others succeed on a full disk."""
_CALLS = ("fsync", "fdatasync", "rename", "replace", "unlink", "remove", "mkdir", "rmdir", "link", "symlink", "ftruncate")
_STRUCK = -int(signal.SIGKILL)


@dataclass(frozen=True)
class Fault:
    """What happens at the call number `step`, from 0 on. error: an errno; 0 kills the process. lasting: the error stays.

    A write is torn before the fault: half of its bytes reach the file. A lasting ENOSPC spares the calls that take no space.
    """

    step: int
    error: int = 0
    lasting: bool = False

    def strikes(self, call: str, step: int) -> bool:
        """Whether the fault strikes a call with this number."""
        if step < self.step or (step > self.step and not self.lasting):
            return False
        return not (self.lasting and self.error == errno.ENOSPC) or call in SPACE

    def strike(self) -> None:
        """Kill the process, or raise the error."""
        if not self.error:
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(self.error, os.strerror(self.error))


@dataclass(frozen=True)
class Outcome:
    """How a child ended. code: the exit code, negative for a signal. steps: how many of its calls changed the disk.

    accepted: how many messages the sessions of the child said to have accepted, notes too.
    """

    code: int
    steps: int
    accepted: int = 0
    out: str = ""
    err: str = ""

    @property
    def killed(self) -> bool:
        return self.code == _STRUCK


def in_child(work: Callable[[], None]) -> int:
    """The exit code of a forked process that does the work: 0 done, 3 an ObjslamError, 4 any other error, -9 killed."""
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
    """The work, with the process killed at its step-th call that changes the disk."""

    def run() -> None:
        arm(Fault(step))
        work()

    return run


def command(
    words: Sequence[str], fault: Fault | None = None, stdin: bytes = b"", before: Callable[[], Any] = int
) -> Outcome:
    """Run an objslam command in a forked process of its own group, with a fault or without. before: called in it first."""
    counter = mmap.mmap(-1, 16)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as given:
        given.write(stdin)
        given.seek(0)
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)
            for number, stream in enumerate((given, out, err)):
                os.dup2(stream.fileno(), number)
            _run_command(words, fault, counter, before)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        texts = [os.pread(stream.fileno(), 1 << 20, 0).decode(errors="replace") for stream in (out, err)]
    steps, accepted = (int.from_bytes(counter[at : at + 8], "little") for at in (0, 8))
    return Outcome(code, steps, accepted, *texts)


def _run_command(words: Sequence[str], fault: Fault | None, counter: mmap.mmap, before: Callable[[], Any]) -> None:
    """Run the command in the child, which never returns from here."""
    code: object = 70
    try:
        sys.stdin, sys.stdout, sys.stderr = (open(number, mode, closefd=False) for number, mode in enumerate("rww"))  # noqa: SIM115
        from objslam.cli import main
        from objslam.cli.console import console_of

        console_of.cache_clear()
        sys.argv = ["objslam", *words]
        signal.alarm(round(LIMIT))  # A command that never ends is killed.
        before()
        _count_accepted(counter)
        arm(fault, counter)
        main()
    except SystemExit as exit_:
        code = exit_.code
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 71)


def _count_accepted(counter: mmap.mmap) -> None:
    """From now on, count the messages that sessions of this process accept, in bytes 8 to 16."""
    from objslam.live.session.session import Session

    enqueue = Session._enqueue

    def counted(self: Session, *message: Any) -> bool:
        accepted = enqueue(self, *message)
        counter[8:] = (int.from_bytes(counter[8:], "little") + accepted).to_bytes(8, "little")
        return accepted

    Session._enqueue = counted  # type: ignore[method-assign]


def arm(fault: Fault | None, counter: mmap.mmap | None = None) -> None:
    """From now on, count the calls of this process that change the disk, and let the fault strike. There is no way back.

    counter: its first 8 bytes hold the count, for the parent process.
    """
    steps = 0

    def touch(call: str, tear: Callable[[], object] | None = None) -> None:
        nonlocal steps
        step, steps = steps, steps + 1
        if counter is not None:
            counter[:8] = steps.to_bytes(8, "little")
        if fault is not None and fault.strikes(call, step):
            if tear is not None:
                tear()
            fault.strike()

    def counted(name: str) -> Callable[..., Any]:
        call = getattr(os, name)

        def run(*args: Any, **kwargs: Any) -> Any:
            touch(name)
            return call(*args, **kwargs)

        return run

    os_open, os_write, sendfile, whole_open = os.open, os.write, os.sendfile, io.open

    def faulty_open(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
        if flags & (os.O_CREAT | os.O_TRUNC):
            touch("open")
        return os_open(path, flags, *args, **kwargs)

    def faulty_write(file: int, data: Any) -> int:
        if stat.S_ISREG(os.fstat(file).st_mode):
            touch("write", lambda: os_write(file, bytes(data)[: len(data) // 2]))
        return os_write(file, data)

    def faulty_sendfile(to: int, source: int, offset: Any, count: int) -> int:
        touch("write")
        return sendfile(to, source, offset, count)

    class Raw(io.FileIO):
        def write(self, data: Any) -> int:
            touch("write", lambda: super(Raw, self).write(bytes(data)[: len(data) // 2]))
            return super().write(data)

        def truncate(self, size: int | None = None) -> int:
            touch("ftruncate")
            return super().truncate(size)

    def open_for(
        file: Any, mode: str = "r", buffering: int = -1, encoding: Any = None, errors: Any = None, newline: Any = None,
        closefd: bool = True, opener: Any = None,
    ) -> Any:  # fmt: skip
        if not set(mode) & set("wax+") or isinstance(file, int):
            return whole_open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        touch("open")
        raw = Raw(file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if buffering == 0:
            return raw
        stream = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

    for name in _CALLS:
        setattr(os, name, counted(name))
    os.open, os.write, os.sendfile = faulty_open, faulty_write, faulty_sendfile
    io.open = builtins.open = open_for  # type: ignore[assignment]


def contents(out: Path) -> dict[str, bytes]:
    """What the files of a folder hold, by name; folders in it, such as what is staged, are left out."""
    return {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}


def tree(folder: Path) -> dict[str, bytes]:
    """What all files under a folder hold, by their path in it, hidden ones and those in hidden folders too."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
