"""A view of a session while it runs: its snapshots go to a viewer or a file and never keep the session waiting."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from objslam.errors import ConfigError, OutputError
from objslam.output.viewer import application
from objslam.output.viewer.application import Viewer
from objslam.output.viewer.live.wire import encode_snapshot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from objslam.core.snapshot import Snapshot

_MAX_WAITING = 4  # The largest number of snapshots that wait for the viewer; of more, the oldest is dropped.
_ADDRESS = re.compile(r"rerun(\+https?)?://[^/\s]+/proxy")  # What the address of a viewer looks like.

Image = Callable[[str, float], "NDArray[np.uint8] | bytes | None"]
"""The image of a camera, by its name, at a stamp, s; None where there is none."""


def open_view(where: str, say: Callable[[str], None], image: Image | None = None) -> LiveView:
    """A live view in a window (`window`), a browser (`web`), a recording (a name that ends in .rrd), or at an address.

    Args:
        say: takes the line that tells the address for a browser.
        image: finds the images of frames.
    """
    if where.endswith(".rrd"):
        return LiveView(file=Path(where), image=image)
    if where not in ("window", "web"):
        return LiveView(address=where, image=image)
    port = application.free_port()
    address = application.address(port)
    if where == "window":  # the window stays open at the end
        application.start_listening(port, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
        return LiveView(address=address, image=image)
    web = application.free_port()
    server = application.start_listening(web, "--serve-web", "--web-viewer-port", str(web), "--port", str(port))
    say(application.web_address(web, port))
    return LiveView(address=address, image=image, server=server)


class LiveView:
    """Shows snapshots. If the viewer is too slow, snapshots are dropped and counted.

    A separate process does the logging, and a thread feeds it. So a viewer that hangs cannot block the session or its end.
    If the viewer is killed, the view tries its address again every few seconds. A new viewer at that address receives the
    snapshots from then on.
    """

    def __init__(
        self, file: Path | None = None, address: str | None = None, image: Image | None = None, server: Viewer | None = None
    ) -> None:
        """Log to a recording file, which can be read at any time, to the viewer at an address, or to both.

        Args:
            image: finds the images of the frames in snapshots; it is called from the view's own thread.
            server: a viewer to stop at the end.
        Raises:
            ConfigError: the address is none.
            OutputError: the file cannot be written.
        """
        if address is not None and not _ADDRESS.fullmatch(address):
            hint = "rerun+http://127.0.0.1:9876/proxy, for example"
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
        self.shown = 0
        """The number of snapshots that arrived."""
        self.dropped = 0
        """The number of snapshots that did not arrive, because the viewer was too slow or gone."""
        self._image = image
        self._waiting: deque[Snapshot] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._server = server
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # rerun reports every message that a dead viewer misses
            start_new_session=True,  # Ctrl+C ends the session, which then ends this process
        )
        self._thread = threading.Thread(target=self._feed, name="objslam live view", daemon=True)
        self._thread.start()

    def show(self, snapshot: Snapshot) -> bool:
        """Take a snapshot and return at once, from any thread; False where an older one was dropped for it."""
        with self._changed:
            full = len(self._waiting) >= _MAX_WAITING
            if full:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(snapshot)
            self._changed.notify_all()
        return not full

    def close(self, timeout: float = 3.0) -> None:
        """Show what waits for at most `timeout`, s, then end the logging, whatever the viewer does."""
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

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _feed(self) -> None:
        """Hand on one snapshot at a time, each when the last has arrived."""
        into, back = self._process.stdin, self._process.stdout
        assert into is not None
        assert back is not None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    break
                snapshot = self._waiting.popleft()
            try:
                into.write(encode_snapshot(self._with_images(snapshot), self.dropped))
                into.flush()
                answer = back.readline()
            except OSError:  # the process is gone
                answer = b""
            with self._changed:
                arrived = answer == b"ok\n"
                self.shown += arrived
                self.dropped += not arrived
            if not answer:
                self._drop_all()
                break
        try:
            into.close()
        except OSError:  # the process is gone, and what was left for it is counted as dropped
            return

    def _with_images(self, snapshot: Snapshot) -> Snapshot:
        find = self._image
        if find is None:
            return snapshot
        frames = (f if f.image is not None else replace(f, image=find(f.camera.name, f.stamp)) for f in snapshot.frames)
        return replace(snapshot, frames=tuple(frames))

    def _drop_all(self) -> None:
        """Count snapshots as dropped until the end: there is no process to show them to."""
        while not self._closing:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                self.dropped += len(self._waiting)
                self._waiting.clear()
