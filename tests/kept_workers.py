"""Processes beside live sessions, kept for the sessions of later tests."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from objslam.live import worker
from objslam.live.worker import Worker

_MOST = 3
"""The most processes that wait for a session. A session has about as many at a time, and each takes memory."""

AS_EVER = ((worker, "_start", worker._start), (Worker, "close", Worker.close))
"""What `kept_workers` replaces: (where, name, what is there without it)."""


@contextmanager
def kept_workers() -> Iterator[None]:
    """Keep the process of a `Worker` that is closed while it has nothing to do, and give it to the next one that starts.

    A start takes half a second for imports, and a session of some seconds makes several. A process may serve any number of
    requests one after another, so it answers as a new one would. A process that failed is ended, as ever. So is one that
    still works when its worker is closed."""
    start, close, idle = worker._start, Worker.close, list[subprocess.Popen[bytes]]()

    def taken() -> subprocess.Popen[bytes] | None:
        while idle:
            process = idle.pop()
            if process.poll() is None:
                return process
            worker._reap(process)
        return start()

    def keep(self: Worker[Any]) -> None:
        process, works = self._process, self._thread is not None and self._thread.is_alive()
        answered = self._answer is not None and not works
        if process is None or not answered or process.poll() is not None or len(idle) >= _MOST:
            close(self)
            return
        idle.append(process)
        self._thread = self._process = None
        self._asked = False

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "_start", taken)
        patch.setattr(Worker, "close", keep)
        try:
            yield
        finally:
            for process in idle:
                worker._reap(process)
            idle.clear()
