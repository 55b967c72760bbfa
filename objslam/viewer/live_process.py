"""The process that a live view logs from: rerun's connection may block for as long as a viewer hangs, and nothing that is
linked to it can then end. Here it blocks nobody, and can be killed.

python -m objslam.viewer.live_process [--file FILE] [--address URL], with messages on its input; on its output a line for
each: "ok" where the viewer or the file has it, "lost" where that is not sure.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from typing import Any

_GRACE = 5.0  # s that a viewer gets to take the last message once the session is gone
_AGAIN = 2.0  # s between two attempts to reach a viewer that is gone


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--file")
    parser.add_argument("--address")
    options = parser.parse_args()

    import rerun as rr

    from objslam.viewer.live_log import LiveLog
    from objslam.viewer.wire import read

    parent = os.getppid()
    recording = rr.RecordingStream("objslam")
    _connect(recording, options)
    log, source, tried = LiveLog(recording), sys.stdin.buffer, time.monotonic()
    lost = False
    while (message := read(source)) is not None:
        if lost and time.monotonic() - tried > _AGAIN:
            _connect(recording, options)
            log.renew()
            tried = time.monotonic()
        log.show(*message)
        lost = not _delivered(recording, parent)
        sys.stdout.write("lost\n" if lost else "ok\n")
        sys.stdout.flush()
    _end_soon()
    recording.disconnect()


def _connect(recording: Any, options: argparse.Namespace) -> None:
    import rerun as rr

    sinks: list[Any] = []
    if options.file is not None:
        sinks.append(rr.FileSink(options.file))
    if options.address is not None:
        sinks.append(rr.GrpcSink(options.address))
    recording.set_sinks(*sinks)


def _delivered(recording: Any, parent: int) -> bool:
    """Wait until what was logged has arrived, however long a viewer hangs, while the session lives; whether it arrived."""
    while True:
        try:
            recording.flush(timeout_sec=1.0)
            return True
        except RuntimeError as error:
            if "timed out" not in str(error):
                return False
        if os.getppid() != parent:
            os._exit(1)


def _end_soon() -> None:
    """End this process in a while, whatever it waits for."""
    timer = threading.Timer(_GRACE, lambda: os._exit(1))
    timer.daemon = True
    timer.start()


if __name__ == "__main__":
    main()
