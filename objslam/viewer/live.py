"""A session to look at while it goes on: snapshots go to a viewer or a file, and never keep the session waiting."""

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
from objslam.viewer import program
from objslam.viewer.wire import encode

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from objslam.live.interface import Snapshot

_WAITING = 4  # snapshots that wait at the most: of more, the oldest is dropped
_ADDRESS = re.compile(r"rerun(\+https?)?://[^/\s]+/proxy")


Image = Callable[[str, float], "NDArray[np.uint8] | bytes | None"]
"""The image of a camera, by its name, at a stamp, s; None where there is none."""


def open_view(where: str, say: Callable[[str], None], image: Image | None = None) -> LiveView:
    """A live view in a window (`window`), a browser (`web`), a recording (a name that ends in .rrd), or at an address.

    image: what finds the images of frames, if anything does.
    """
    if where == "window":
        return LiveView.spawn(image=image)
    if where == "web":
        return LiveView.serve(say, image=image)
    if where.endswith(".rrd"):
        return LiveView(file=Path(where), image=image)
    return LiveView(address=where, image=image)


class LiveView:
    """Shows snapshots: `show` takes one and returns at once, from any thread; what a slow viewer has no time for is dropped
    and counted.

    The logging happens in a process of its own, fed by a thread: a viewer that hangs stops neither the session nor its end.
    A viewer that was killed is looked for again every few seconds; started anew at the same address, it gets all that comes.
    """

    def __init__(self, *, file: Path | None = None, address: str | None = None, image: Image | None = None) -> None:
        """Log to a recording file (as it comes: readable at any time), to the viewer at an address, or to both.

        image: finds the images of the frames in snapshots; it is called from the view's own thread.
        ConfigError where an address is none; OutputError where the file cannot be written.
        """
        if address is not None and not _ADDRESS.fullmatch(address):
            raise ConfigError(
                f"{address!r} is no address of a viewer", hint="rerun+http://127.0.0.1:9876/proxy, for example"
            )
        arguments = [sys.executable, "-m", "objslam.viewer.live_process"]
        if file is not None:
            try:
                file.open("wb").close()
            except OSError as error:
                raise OutputError(f"cannot write: {error.strerror}", where=str(file)) from error
            arguments += ["--file", str(file)]
        if address is not None:
            arguments += ["--address", address]
        self.shown = 0
        """Snapshots that arrived."""
        self.dropped = 0
        """Snapshots that did not: the viewer was too slow, or gone."""
        self._image = image
        self._waiting: deque[Snapshot] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._viewer: subprocess.Popen[bytes] | None = None
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # rerun reports every message that a dead viewer misses
            start_new_session=True,  # Ctrl+C is for the session: it then ends this
        )
        self._thread = threading.Thread(target=self._feed, name="objslam live view", daemon=True)
        self._thread.start()

    @classmethod
    def spawn(cls, *, file: Path | None = None, image: Image | None = None) -> Self:
        """Open the native viewer; it stays open at the end. OutputError where it cannot open."""
        port = program.free_port()
        viewer = program.start("--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
        program.wait_for(viewer, port)
        program.let_go(viewer)
        return cls(file=file, address=program.address(port), image=image)

    @classmethod
    def serve(cls, say: Callable[[str], None], *, file: Path | None = None, image: Image | None = None) -> Self:
        """Serve a viewer to a browser on this machine, until the end; say(text) gets the address."""
        web, port = program.free_port(), program.free_port()
        viewer = program.start("--serve-web", "--web-viewer-port", str(web), "--port", str(port))
        program.wait_for(viewer, web)
        program.let_go(viewer)
        say(program.web_address(web, port))
        view = cls(file=file, address=program.address(port), image=image)
        view._viewer = viewer
        return view

    def show(self, snapshot: Snapshot) -> bool:
        """Take a snapshot; False where an older one was dropped for it."""
        with self._changed:
            full = len(self._waiting) >= _WAITING
            if full:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(snapshot)
            self._changed.notify_all()
        return not full

    def close(self, timeout: float = 3.0) -> None:
        """Show what waits, at the most so many seconds, s, then let go of the viewer however it is."""
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
        if self._viewer is not None:
            program.stop(self._viewer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _feed(self) -> None:
        """Hand on one snapshot at a time: the next when the last has arrived."""
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
                into.write(encode(self._with_images(snapshot), self.dropped))
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
        except OSError:  # what was left in it has nowhere to go: it is counted
            return

    def _with_images(self, snapshot: Snapshot) -> Snapshot:
        find = self._image
        if find is None:
            return snapshot
        frames = (f if f.image is not None else replace(f, image=find(f.camera.name, f.stamp)) for f in snapshot.frames)
        return replace(snapshot, frames=tuple(frames))

    def _drop_all(self) -> None:
        """Without a process there is nothing to show to: count until the end."""
        while not self._closing:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                self.dropped += len(self._waiting)
                self._waiting.clear()
