"""The process that logs the snapshots of a session to a viewer or a file.

A hanging viewer blocks rerun's connection and the end of the connected process. This process can be killed.
Start: `python -m objslam.output.viewer.live.live_process [--file FILE] [--address URL]`. The process reads messages from stdin
and answers each message with a line: "ok" if the viewer or the file has received it, "lost" if this is uncertain.
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

_GRACE = 5.0  # After the end of the session, a viewer has this time, s, to receive the last message.
_RETRY = 2.0  # Two attempts to reach a lost viewer are at least this time, s, apart.


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--file")
    parser.add_argument("--address")
    options = parser.parse_args()
    parent = os.getppid()
    recording = rr.RecordingStream("objslam")
    _connect(recording, options)
    log, tried, lost = LiveLog(recording), time.monotonic(), False
    while (message := read_snapshot(sys.stdin.buffer)) is not None:
        if lost and time.monotonic() - tried > _RETRY:
            _connect(recording, options)
            log.begin()
            tried = time.monotonic()
        log.show(*message)
        lost = not _delivered(recording, parent)
        print("lost" if lost else "ok", flush=True)
    timer = threading.Timer(_GRACE, lambda: os._exit(1))  # A hanging viewer would block `disconnect` for ever.
    timer.daemon = True
    timer.start()
    recording.disconnect()


def _connect(recording: Any, options: argparse.Namespace) -> None:
    chosen = ((rr.FileSink, options.file), (rr.GrpcSink, options.address))
    recording.set_sinks(*(sink(target) for sink, target in chosen if target is not None))


def _delivered(recording: Any, parent: int) -> bool:
    """Wait until the logged data have arrived; return False if they are lost, and exit if the session has ended."""
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
