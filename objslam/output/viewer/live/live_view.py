"""Show the snapshots of a running session in a viewer, or write them to a file. The session never waits for this."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from objslam.errors import ConfigError, OutputError
from objslam.io.threads import start_thread
from objslam.output.viewer import application
from objslam.output.viewer.application import Viewer
from objslam.output.viewer.live.wire import encode_snapshot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from objslam.core.snapshot import Snapshot

_MAX_WAITING = 4  # The largest number of snapshots that wait for the viewer. If one more comes, the oldest is dropped.
_ADDRESS = re.compile(r"rerun(\+https?)?://[^/\s]+/proxy")  # The form of a viewer's address.

Image = Callable[[str, float], "NDArray[np.uint8] | bytes | None"]
"""A function that takes a camera's name and a stamp, s, and returns an image, or None if there is no image."""


def open_view(where: str, say: Callable[[str], None], image: Image | None = None) -> LiveView:
    """Return a new live view.

    Args:
        where: `window`, `web` for a browser, the name of a recording (.rrd), or the address of a viewer.
        say: a function that gets a line with the address for the browser.
        image: a function that finds the images of camera frames.
    """
    if where.endswith(".rrd"):
        return LiveView(file=Path(where), image=image)
    if where not in ("window", "web"):
        return LiveView(address=where, image=image)
    port = application.free_port()
    address = application.address(port)
    if where == "window":  # The window stays open after the session.
        application.start_listening(port, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
        return LiveView(address=address, image=image)
    web = application.free_port()
    server = application.start_listening(web, "--serve-web", "--web-viewer-port", str(web), "--port", str(port))
    say(application.web_address(web, port))
    return LiveView(address=address, image=image, server=server)


class LiveView:
    """A view that shows the snapshots of a session. If the viewer is too slow, snapshots are dropped and counted.

    A separate process logs the snapshots, and a thread feeds this process. A viewer that hangs can therefore not block the
    session or its end. If the viewer is killed, the process tries its address every few seconds. A new viewer at this
    address gets the later snapshots.
    """

    def __init__(
        self, file: Path | None = None, address: str | None = None, image: Image | None = None, server: Viewer | None = None
    ) -> None:
        """Start to log to a recording file, to the viewer at an address, or to both.

        Args:
            file: the recording. It can be read at any time.
            image: a function that finds the images of camera frames. The thread of the view calls this function.
            server: a viewer to stop at the end.
        Raises:
            ConfigError: the address is malformed.
            OutputError: the file cannot be written.
        """
        if address is not None and not _ADDRESS.fullmatch(address):
            hint = "give window, web, FILE.rrd, or an address such as rerun+http://127.0.0.1:9876/proxy"
            raise ConfigError(f"{address!r} is no address of a viewer", hint=hint)
        arguments = [sys.executable, "-m", "objslam.output.viewer.live.live_process"]
        if file is not None:
            try:
                file.open("wb").close()
            except OSError as error:
                raise OutputError(f"cannot write: {error.strerror}", where=str(file)) from error
            arguments += ["--file", str(file)]
        if address is not None:
            arguments += ["--address", address]
        self.shown = 0  # The number of snapshots that arrived.
        self.dropped = 0  # The number of snapshots that were lost, because the viewer was too slow or had ended.
        self._image = image
        self._waiting: deque[Snapshot] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._server = server
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # Otherwise rerun reports each message that an ended viewer misses.
            start_new_session=True,  # Ctrl+C ends the session, and the session ends this process.
        )
        self._thread = threading.Thread(target=self._feed, name="objslam live view", daemon=True)
        start_thread(self._thread)

    def show(self, snapshot: Snapshot) -> bool:
        """Queue a snapshot and return at once. Return False if an older snapshot was dropped. Any thread may call this."""
        with self._changed:
            full = len(self._waiting) >= _MAX_WAITING
            if full:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(snapshot)
            self._changed.notify_all()
        return not full

    def close(self, timeout: float = 3.0) -> None:
        """Wait at most `timeout` (s) until the queued snapshots are shown, and end the process."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout)
        try:
            self._process.wait(0.0 if self._thread.is_alive() else timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join()
        self.dropped += len(self._waiting)
        self._waiting.clear()
        if self._server is not None:
            application.stop(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _feed(self) -> None:
        """Send one snapshot at a time to the process. If the process has ended, count the snapshots as dropped."""
        into, back = self._process.stdin, self._process.stdout
        assert into is not None
        assert back is not None
        answer = b"ok\n"
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    break
                snapshot = self._waiting.popleft()
            if answer:  # The answer is empty once the process has ended.
                try:
                    into.write(encode_snapshot(self._with_images(snapshot), self.dropped))
                    into.flush()
                    answer = back.readline()
                except OSError:
                    answer = b""
            with self._changed:
                arrived = answer == b"ok\n"
                self.shown += arrived
                self.dropped += not arrived
        with suppress(OSError):  # The process has ended.
            into.close()

    def _with_images(self, snapshot: Snapshot) -> Snapshot:
        find = self._image
        if find is None:
            return snapshot
        frames = (f if f.image is not None else replace(f, image=find(f.camera.name, f.stamp)) for f in snapshot.frames)
        return replace(snapshot, frames=tuple(frames))
