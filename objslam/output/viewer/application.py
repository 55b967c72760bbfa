"""Start the rerun viewer as a separate process: in a window, in a browser, or without a screen for a screenshot."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from objslam.errors import ConfigError, OutputError
from objslam.io.atomic_files import disk_errors
from objslam.io.folders import remove_leftovers, temporary_name
from objslam.io.results.files import OBJECTS, RECORDING, hint_below
from objslam.io.results.read import refuse_site
from objslam.io.threads import start_thread
from objslam.output.viewer.times import STAMP

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

_T = TypeVar("_T")
Viewer = subprocess.Popen[bytes]
"""The process of a viewer."""

_LOOPBACK = "127.0.0.1"  # Viewers listen at this address. Other machines cannot reach it.
_PATIENCE = 60.0  # The longest time, s, in which a viewer must start and load a recording.
_SETTLE = 1.5  # The time, s, in which a viewer draws after its time is set. Slower machines need a larger value.
_NO_DRIVER = ("render context", "No graphics adapter", "Failed to find a suitable", "NoSuitableAdapter", "adapter was found")
"""Texts in the viewer's stderr on a machine without a Vulkan driver."""
_NO_SCREEN = ("XOpenDisplay", "neither WAYLAND", "WAYLAND_DISPLAY", "WinitEventLoop", "Failed to open connection")
"""Texts in the viewer's stderr on a machine without a screen."""


def program() -> Path:
    """Return the path of the viewer's executable. Raises OutputError if rerun was installed without the viewer."""
    import rerun_cli

    found = Path(rerun_cli.__file__).parent / ("rerun.exe" if os.name == "nt" else "rerun")
    if not found.is_file():
        hint = "pip install --force-reinstall rerun-sdk"
        raise OutputError("rerun's viewer is not installed", where=str(found), hint=hint)
    return found


def find_rrd(out: Path) -> Path:
    """Return the path of the recording. out: the recording itself, or a result folder that contains it.

    Raises OutputError if the recording is missing or damaged.
    """
    from rerun.chunk import RrdReader

    file = out if out.is_file() else out / RECORDING
    if not out.exists():
        raise OutputError("there is no such result folder", where=str(out))
    if not file.is_file() and not (out / OBJECTS).is_file():
        raise OutputError(f"no result here: {OBJECTS} is missing", where=str(out), hint=hint_below(out))
    if not file.is_file():
        refuse_site(out, RECORDING)
        hint = hint_below(out) or "run with output.recording=true, and name the new result"
        raise OutputError("no recording here", where=str(out), hint=hint)
    try:
        # The whole file is read, because the viewer waits for the rest of a damaged recording.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # A recording of a live session has no footer, but the viewer can show it.
            reader = RrdReader(file)
            for store in [*reader.recordings(), *reader.blueprints()]:
                for _ in reader.stream(store=store).to_chunks():
                    pass
        if not reader.recordings():
            raise ValueError("it is empty")
    except (RuntimeError, ValueError, OSError) as error:
        why = str(error).splitlines()[0].removeprefix(f"Failed to read RRD file at {file}: ")
        raise OutputError(f"the recording is damaged or cut off ({why})", where=str(file), hint="run again") from error
    return file


def free_port() -> int:
    """Return a free port of the loopback interface."""
    with socket.socket() as s:
        s.bind((_LOOPBACK, 0))
        port: int = s.getsockname()[1]
        return port


def address(port: int) -> str:
    """Return the address at which a viewer on this machine receives data."""
    return f"rerun+http://{_LOOPBACK}:{port}/proxy"


def web_address(web: int, port: int) -> str:
    """Return the address for a browser. `web` is the port of the page, and `port` is the port of the data."""
    return f"http://{_LOOPBACK}:{web}?url={address(port).replace('+', '%2B')}"


def start(*arguments: str) -> Viewer:
    """Start the viewer on the loopback interface. By default, rerun would listen on every network interface."""
    return subprocess.Popen(
        [str(program()), "--bind", _LOOPBACK, *arguments],
        env={**os.environ, "RUST_LOG": "error"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def show(files: list[Path]) -> None:
    """Open recordings in a window of the viewer and wait until it is closed. Raises OutputError if the viewer fails."""
    viewer = start("--port", str(free_port()), *map(str, files))
    try:
        _, said = viewer.communicate()
    finally:
        stop(viewer)
    if viewer.returncode not in (0, -15, -2):
        raise _failure(viewer.returncode, said, "use --web, or --screenshot FILE.png")


def serve(files: list[Path], say: Callable[[str], None]) -> None:
    """Serve recordings to a browser on this machine until Ctrl+C. say: a function that gets the address as text.

    Raises OutputError if the viewer fails.
    """
    web, data = free_port(), free_port()
    viewer = start("--serve-web", "--web-viewer-port", str(web), "--port", str(data), *map(str, files))
    try:
        with suppress(KeyboardInterrupt):  # Ctrl+C ends the server.
            _wait_for(viewer, web)
            say(f"{web_address(web, data)} (Ctrl+C ends it)")
            _, said = viewer.communicate()
            raise _failure(viewer.returncode, said, None)
    finally:
        stop(viewer)


def screenshot(
    files: list[Path], picture: Path, size: tuple[int, int] = (1600, 900), at: float = 0.5, timeline: str = STAMP
) -> None:
    """Write a picture of recordings in the layout of the viewer at its start. This function needs no screen.

    Args:
        size: width and height of the picture, in points of the screen.
        at: the time of the picture, as a share of the timeline's length, in [0, 1].
        timeline: the name of the timeline.
    Raises:
        ConfigError: the picture's name does not end in .png.
        OutputError: there is no Vulkan driver, the viewer fails, or the picture cannot be written.
    """
    from rerun.experimental import ViewerClient

    if picture.suffix.lower() != ".png":
        raise ConfigError("a picture is a PNG", where=str(picture), hint="name the file FILE.png")
    if not picture.parent.is_dir():
        raise OutputError("no such folder for the picture", where=str(picture.parent))
    temporary = picture.with_name(f"{temporary_name(picture)}.png")
    with disk_errors(picture):
        remove_leftovers(picture)
    port = free_port()
    window = f"{size[0]}x{size[1]}"
    viewer = start("--headless", "--hide-welcome-screen", "--port", str(port), "--window-size", window, *map(str, files))

    def attempt() -> ViewerClient | None:
        client = ViewerClient.connect(address(port))
        state = client.get_state()
        return client if state.recordings and not state.loading and state.views else None

    try:
        client = _retry(viewer, attempt)
        if client is None:
            where = ", ".join(map(str, files))
            raise OutputError(f"the viewer has not loaded the recording in {_PATIENCE:g} s", where=where)
        _set_time(client, at, timeline)
        time.sleep(_SETTLE)
        client.save_screenshot(str(temporary.resolve()))
        temporary.replace(picture)
    except RuntimeError as error:
        raise OutputError(f"the viewer took no picture: {str(error).splitlines()[0]}", where=str(picture)) from error
    except FileNotFoundError as error:
        raise OutputError("the viewer wrote no picture", where=str(picture)) from error
    finally:
        stop(viewer)
        temporary.unlink(missing_ok=True)


def _retry(viewer: Viewer, attempt: Callable[[], _T | None]) -> _T | None:
    """Call `attempt` until it returns a value, and return this value. Return None after `_PATIENCE`.

    Raises OutputError if the viewer ends.
    """
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        if viewer.poll() is not None:
            raise _failure(viewer.returncode, viewer.communicate()[1], None)
        with suppress(RuntimeError, OSError):  # The viewer does not answer yet.
            if (value := attempt()) is not None:
                return value
        time.sleep(0.1)
    return None


def _set_time(client: ViewerClient, share: float, timeline: str) -> None:
    """Pause the viewer at a moment of a timeline. share: the part of the timeline before this moment, in [0, 1]."""
    state = client.get_state()
    recording = next((r for r in state.recordings if r.store_id == state.active_recording), state.recordings[0])
    line = next((t for t in recording.timelines if t.name == timeline), None)
    if line is None:
        return
    start, end = line.start or 0, line.end or 0
    moment = round(start + share * (end - start))
    if line.time_type == "sequence":
        client.set_time(line.name, sequence=moment, play_state="paused")
    elif line.time_type == "timestamp":
        client.set_time(line.name, timestamp=np.datetime64(moment, "ns"), play_state="paused")
    else:
        client.set_time(line.name, duration=np.timedelta64(moment, "ns"), play_state="paused")


def _failure(code: int | None, said: bytes | None, hint: str | None) -> OutputError:
    """Return the error for a viewer that ended, from its exit code and its stderr."""
    text = (said or b"").decode(errors="replace")
    if any(sign in text for sign in _NO_DRIVER):
        hint = "Debian and Ubuntu: apt install libvulkan1 mesa-vulkan-drivers"
        return OutputError("the viewer finds no Vulkan driver to draw with", hint=hint)
    if any(sign in text for sign in _NO_SCREEN):
        return OutputError("the viewer finds no screen", hint=hint)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if "XDG_RUNTIME_DIR" not in line]  # Every machine without a desktop prints this line.
    panic = next((" ".join(lines[i : i + 2]) for i, line in enumerate(lines) if "panicked" in line), None)
    reason = panic or next((line for line in lines if "error" in line.lower()), lines[0] if lines else "")
    return OutputError(f"the viewer ended with code {code}" + (f": {reason[:200]}" if reason else ""), hint=hint)


def _wait_for(viewer: Viewer, port: int) -> None:
    """Wait until a viewer listens on a port. Raises OutputError if the viewer ends or does not answer."""

    def attempt() -> bool:
        socket.create_connection((_LOOPBACK, port), timeout=0.5).close()
        return True

    if _retry(viewer, attempt) is None:
        stop(viewer)
        raise OutputError(f"the viewer does not answer at port {port} in {_PATIENCE:g} s")


def start_listening(port: int, *arguments: str) -> Viewer:
    """Start a viewer and wait until it listens on a port. Raises OutputError if the viewer ends or does not answer."""
    viewer = start(*arguments)
    _wait_for(viewer, port)
    assert viewer.stderr is not None
    # A thread reads the viewer's stderr and ignores it, because the viewer would block at a full pipe.
    start_thread(threading.Thread(target=viewer.stderr.read, name="objslam viewer", daemon=True))
    return viewer


def stop(viewer: Viewer) -> None:
    """End the process of a viewer."""
    if viewer.poll() is None:
        viewer.terminate()
        try:
            viewer.wait(5.0)
        except subprocess.TimeoutExpired:
            viewer.kill()
            viewer.wait()
