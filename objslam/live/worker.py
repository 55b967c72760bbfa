"""Work beside a running session, in a separate process, because GTSAM and numpy stop the other threads of their process."""

from __future__ import annotations

import os
import pickle
import queue
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import IO, Generic, Protocol, TypeVar

from objslam.io.threads import start_thread

Answer_co = TypeVar("Answer_co", covariant=True)
Answer = TypeVar("Answer")

_PATIENT = 600.0
"""The longest time, s, that a request may take. A larger value waits longer for a process that hangs."""
_NICE = 10
"""The niceness of the process, added to the session's (`os.nice`). A larger number leaves more CPU time to the session."""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_LENGTH = struct.Struct("<Q")
"""The format of the number before each message. This number is the length of the message in bytes."""


class Request(Protocol[Answer_co]):
    """Work for a separate process. The request and its answer are pickled."""

    def solve(self) -> Answer_co:
        """Return the answer."""


def solved(request: Request[Answer]) -> Answer | None:
    """Solve a request in this process. Return None if it fails, as a `Worker` does."""
    try:
        return request.solve()
    except Exception:  # noqa: BLE001 - a request that fails must not end the session
        return None


class Worker(Generic[Answer]):
    """A process that solves one request after another. It starts with the first request, and starts again after a
    failure."""

    def __init__(self) -> None:
        self._answer: Answer | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._asked = False
        self._thread: threading.Thread | None = None  # Waits for the answer. None if it could not start.
        self._waiting: list[bytes] = []  # The request until it is sent, because it may be large.

    def ask(self, request: Request[Answer]) -> None:
        """Send a request. The caller must first take the `result` of the previous request."""
        self._answer, self._asked = None, True
        if self._process is None or self._process.poll() is not None:
            self._process = _start()
        self._waiting = [pickle.dumps(request)]
        thread = threading.Thread(target=self._run, name="objslam worker", daemon=True)
        with suppress(OSError, RuntimeError):  # Without memory for a thread, `result` returns None.
            start_thread(thread)
            self._thread = thread

    @property
    def busy(self) -> bool:
        """Whether a request was sent whose `result` was not taken."""
        return self._asked

    @property
    def done(self) -> bool:
        """Whether a request was sent and `result` returns at once."""
        return self._asked and (self._thread is None or not self._thread.is_alive())

    def result(self) -> Answer | None:
        """Wait for the answer to the request, and return it. Return None if the process failed."""
        if self._thread is not None:
            self._thread.join()
        self._thread, self._asked = None, False
        return self._answer

    def close(self) -> None:
        """End the process without waiting for its answer."""
        if self._process is not None:
            self._process.kill()
        if self._thread is not None:
            self._thread.join()
        if self._process is not None:
            _reap(self._process)
        self._thread = self._process = None
        self._asked = False

    def _run(self) -> None:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return
        limit = threading.Timer(_PATIENT, process.kill)
        limit.daemon = True
        with suppress(OSError, RuntimeError):  # The process has ended, or there is no memory for a thread.
            start_thread(limit)
            _write(process.stdin, self._waiting.pop())
            answer = _read(process.stdout)
            if answer is not None:
                self._answer = pickle.loads(answer)  # noqa: S301 - this program wrote it
        limit.cancel()
        if self._answer is None:  # The request failed, or its answer is None. The next request gets a new process.
            _reap(process)


def _start() -> subprocess.Popen[bytes] | None:
    package = str(Path(__file__).parents[2])
    paths = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        return subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_THREADS, "PYTHONPATH": paths},
            start_new_session=True,  # Ctrl+C ends the session, and the session ends this process.
        )
    except OSError:  # Then `Worker.result` returns None.
        return None


def _reap(process: subprocess.Popen[bytes]) -> None:
    """End a process, and close its pipes."""
    process.kill()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # What was not written yet cannot be written any more.
                pipe.close()
    process.wait()


def _write(pipe: IO[bytes], content: bytes) -> None:
    pipe.write(_LENGTH.pack(len(content)))
    pipe.write(content)
    pipe.flush()


def _read(pipe: IO[bytes]) -> bytes | None:
    """Return the next message, or None at the end of the pipe."""
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    content = pipe.read(length)
    return content if len(content) == length else None


def main() -> None:
    """Read requests from stdin, and write their answers to stdout, until stdin ends."""
    os.nice(_NICE)
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(requests,), name="requests", daemon=True).start()
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as answers:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # What a library prints must not get between the answers.
        while True:
            request: Request[object] = pickle.loads(requests.get())  # noqa: S301 - this program wrote it
            _write(answers, pickle.dumps(request.solve()))


def _receive(requests: queue.SimpleQueue[bytes]) -> None:
    """Read requests until stdin ends, and then end this process. If the session is killed, the end of stdin is the only sign
    that reaches this process."""
    try:
        with os.fdopen(os.dup(sys.stdin.fileno()), "rb") as asked:  # Python waits for the lock of sys.stdin when it ends.
            while (content := _read(asked)) is not None:
                requests.put(content)
    finally:  # Without a reader, for example because there is no memory for a request, the session would wait in vain.
        os._exit(0)


if __name__ == "__main__":
    main()
