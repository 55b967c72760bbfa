"""A process that does one task after another, with a limit of memory and of time for each.

A task is a function, named as "module:function", and one argument. The limits are watched from outside, because native code
neither returns to Python nor lets another thread of its process run. The memory is the RAM of the process. RLIMIT_AS and
RLIMIT_DATA do not limit it: they count what libraries reserve, 2.0 and 1.35 GB for a process that uses 0.28 GB.
"""

from __future__ import annotations

import ctypes
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from objslam.errors import ObjslamError

_WATCH = 0.05
"""The pause between two looks at memory and time, s. A larger value costs less, and ends a task later."""
_TIRED = 0.5
"""The share of the memory limit that a process may still use after a task. A process that uses more is replaced, so that the
next task has its memory. A larger share replaces processes less often."""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""The environment variables that give numerical libraries one thread, because each core has a process of its own."""
_PAGE = os.sysconf("SC_PAGE_SIZE")
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux.


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a task. memory: bytes of RAM, 0 for no limit. seconds: its longest duration, s, 0 for no limit. retries:
    how often the task begins again after its process died."""

    memory: int = 0
    seconds: float = 0.0
    retries: int = 2


class LimitError(ObjslamError):
    """A task needs more than its limit. kind: memory or time."""

    def __init__(self, kind: str, message: str, hint: str) -> None:
        super().__init__(message, hint=hint)
        self.kind = kind


class LostError(ObjslamError):
    """The process of a task died: by a signal, or because native code ended it."""


class Worker:
    """A process of this machine. It starts with its first task, and a process that died is replaced."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._closed = False

    def call(self, work: str, argument: Any, limits: Limits) -> Any:
        """Return what the function `work` returns for an argument. The task begins again if its process dies.

        Raises what the function raises, LimitError for a task that is beyond a limit, and LostError if the process died
        in every try.
        """
        for left in range(limits.retries, -1, -1):
            try:
                return self._call(work, argument, limits)
            except LostError:
                if not left or self._closed:
                    raise
        raise AssertionError  # The last try returns or raises.

    def close(self) -> None:
        """End the process, whatever it does, and start no other one. Any thread may call this."""
        self._closed = True
        process = self._process  # The thread of its task may set it to None meanwhile.
        if process is not None:
            process.kill()
            process.wait()  # If the process is idle, no thread of a task waits for its end.

    def _end(self) -> None:
        """End the process. The next task starts another one."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None

    def _call(self, work: str, argument: Any, limits: Limits) -> Any:
        pipe = self._started()
        end = time.monotonic() + limits.seconds if limits.seconds else float("inf")
        try:
            pipe.send((work, argument))
            while not pipe.poll(_WATCH):
                if limits.memory and self._memory() > limits.memory:
                    raise LimitError("memory", f"needs more than the {limits.memory / 1e9:.1f} GB of a task", "--memory")
                if time.monotonic() > end:
                    raise LimitError("time", f"needs more than the {limits.seconds:g} s of a task", "--time-limit")
            good, answer = pipe.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise LostError(self._last_words()) from error
        except BaseException:
            self._end()
            raise
        if limits.memory and self._memory() > _TIRED * limits.memory:
            self._end()
        if not good:
            raise answer
        return answer

    def _started(self) -> Connection:
        if self._pipe is None:
            ours, theirs = socket.socketpair()
            package = str(Path(__file__).parents[3])
            paths = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
            start = f"from objslam.fleet.engines.worker import serve; serve({theirs.fileno()}, {os.getpid()})"
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", start],
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr.fileno() if _is_open(sys.stderr) else subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_THREADS, "PYTHONPATH": paths},
                start_new_session=True,  # Ctrl+C ends the driver, and the driver ends this process.
            )
            theirs.close()
            self._pipe = Connection(ours.detach())
            if self._closed:  # Another thread closed the worker meanwhile.
                self._process.kill()
        return self._pipe

    def _memory(self) -> int:
        """Return the bytes that the process has in RAM, 0 if it died."""
        assert self._process is not None
        try:
            return int(Path(f"/proc/{self._process.pid}/statm").read_bytes().split()[1]) * _PAGE
        except (OSError, IndexError):
            return 0

    def _last_words(self) -> str:
        """Clean up after a process that died, and return why it died."""
        process = self._process
        assert process is not None
        self._end()
        code = process.returncode
        if code >= 0:
            return f"the process of the task ended with code {code}"
        name = next((one.name for one in signal.Signals if one == -code), str(-code))
        more = ", as when the machine is out of memory" if -code == signal.SIGKILL else ""
        return f"the process of the task died by {name}{more}"


def serve(handle: int, parent: int) -> None:
    """Do the tasks that come over a socket, until the socket closes. The process dies with its parent.

    handle: the file descriptor of the socket. parent: the process id of the parent.
    """
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:  # The parent died before prctl was called.
        return
    logging.getLogger("objslam").setLevel(logging.ERROR)  # The warnings of a run are in its result.
    pipe = Connection(handle)
    while True:
        try:
            work, argument = pipe.recv()
        except EOFError:
            return
        try:
            answer = True, resolve_name(work)(argument)
        except Exception as error:  # noqa: BLE001 - The parent raises it.
            answer = False, error if isinstance(error, ObjslamError | MemoryError) else _told(error)
        pipe.send(answer)


def _told(error: Exception) -> ObjslamError:
    """Return an error that the parent can raise, with the text of an error whose class the parent may not know."""
    return ObjslamError(f"internal error, {type(error).__name__}: {error}", hint="please report it")


def _is_open(stream: Any) -> bool:
    try:
        return stream is not None and stream.fileno() >= 0
    except (OSError, ValueError):
        return False
