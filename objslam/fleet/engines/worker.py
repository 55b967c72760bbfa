"""A process that does one task after another. Each task has a memory limit and a time limit.

A task is a function, named as "module:function", and one argument. The parent of the process checks the limits, because
native code neither returns to Python nor lets another thread of its process run. The memory limit is a limit on the RAM of
the process. RLIMIT_AS and RLIMIT_DATA cannot set such a limit, because they also count memory that libraries only reserve.
For a process that uses 0.28 GB, they count 2.0 and 1.35 GB.
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
"""The time (s) between two checks of the limits. With a larger value, the checks cost less, and a task beyond its limit ends
later."""
_TIRED = 0.5
"""The largest share of the memory limit that a process may still use after a task. A process that uses more is replaced, so
that the next task has enough memory. With a larger share, processes are replaced less often."""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""The environment variables that give each numerical library one thread, because each core has a process of its own."""
_PAGE = os.sysconf("SC_PAGE_SIZE")
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux.


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a task. memory: the most RAM, bytes, 0 for no limit. seconds: the longest duration, s, 0 for no limit.
    retries: how often the task begins again after its process died."""

    memory: int = 0
    seconds: float = 0.0
    retries: int = 2


class LimitError(ObjslamError):
    """A task exceeds one of its limits. kind: the limit, `memory` or `time`."""

    def __init__(self, kind: str, message: str, hint: str) -> None:
        super().__init__(message, hint=hint)
        self.kind = kind


class LostError(ObjslamError):
    """The process of a task died by a signal, or because native code ended it."""


class Worker:
    """A process of this machine that does tasks. It starts with its first task. If it dies, the next try starts another
    process."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._closed = False

    def call(self, work: str, argument: Any, limits: Limits) -> Any:
        """Return what the function `work` returns for an argument. If the process dies, the task begins again.

        Raises the error of the function, LimitError for a task that exceeds a limit, and LostError if the process died in
        every try.
        """
        for left in range(limits.retries, -1, -1):
            try:
                return self._call(work, argument, limits)
            except LostError:
                if not left or self._closed:
                    raise
        raise AssertionError  # The last try returns or raises.

    def close(self) -> None:
        """End the process, even if it does a task, and start no other process. Any thread may call this method."""
        self._closed = True
        process = self._process  # Another thread may set self._process to None at any time.
        if process is not None:
            process.kill()
            process.wait()  # No other thread waits for the end of an idle process.

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
    """Return an `ObjslamError` with the text of another error. The parent may not know the class of the other error."""
    return ObjslamError(f"internal error, {type(error).__name__}: {error}", hint="please report it")


def _is_open(stream: Any) -> bool:
    try:
        return stream is not None and stream.fileno() >= 0
    except (OSError, ValueError):
        return False
