"""The process that a live view logs from.

rerun's connection blocks as long as a viewer hangs, and keeps its process from ending. This process can be killed. It is
started as `python -m objslam.output.viewer.live.live_process [--file FILE] [--address URL]`, with messages on its input. It
answers each with a line: "ok" where the viewer or the file has it, "lost" where that is not sure.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from typing import Any

import rerun as rr

from objslam.output.viewer.live.live_log import LiveLog
from objslam.output.viewer.live.wire import read_snapshot

_GRACE = 5.0  # The time, s, that a viewer has to take the last message once the session is gone.
_RETRY = 2.0  # The time, s, between two attempts to reach a viewer that is gone.


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--file")
    parser.add_argument("--address")
    options = parser.parse_args()
    parent = os.getppid()
    recording = rr.RecordingStream("objslam")
    _connect(recording, options)
    log, source, tried = LiveLog(recording), sys.stdin.buffer, time.monotonic()
    lost = False
    while (message := read_snapshot(source)) is not None:
        if lost and time.monotonic() - tried > _RETRY:
            _connect(recording, options)
            log.begin()
            tried = time.monotonic()
        log.show(*message)
        lost = not _delivered(recording, parent)
        sys.stdout.write("lost\n" if lost else "ok\n")
        sys.stdout.flush()
    timer = threading.Timer(_GRACE, lambda: os._exit(1))  # a viewer that hangs would keep this process for ever
    timer.daemon = True
    timer.start()
    recording.disconnect()


def _connect(recording: Any, options: argparse.Namespace) -> None:
    sinks: list[Any] = []
    if options.file is not None:
        sinks.append(rr.FileSink(options.file))
    if options.address is not None:
        sinks.append(rr.GrpcSink(options.address))
    recording.set_sinks(*sinks)


def _delivered(recording: Any, parent: int) -> bool:
    """Wait until what was logged has arrived, as long as the session lives; False where it was lost."""
    while True:
        try:
            recording.flush(timeout_sec=1.0)
            return True
        except RuntimeError as error:
            if "timed out" not in str(error):
                return False
        if os.getppid() != parent:
            os._exit(1)


if __name__ == "__main__":
    main()
