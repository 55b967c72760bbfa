"""The rerun viewer as a program of its own: on the screen, in a browser, or without either for a picture."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from objslam.errors import ConfigError, OutputError
from objslam.results import RECORDING, hint_below
from objslam.viewer.times import STAMP

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

LOOPBACK = "127.0.0.1"
_PATIENCE = 60.0  # s until a viewer without a screen has loaded a recording
_SETTLE = 1.5  # s for it to draw after the time was set
_NO_DRIVER = ("render context", "No graphics adapter", "Failed to find a suitable", "NoSuitableAdapter", "adapter was found")
_NO_SCREEN = ("XOpenDisplay", "neither WAYLAND", "WAYLAND_DISPLAY", "WinitEventLoop", "Failed to open connection")


def program() -> Path:
    """The viewer's program; OutputError where rerun was installed without it."""
    import rerun_cli

    found = Path(rerun_cli.__file__).parent / ("rerun.exe" if os.name == "nt" else "rerun")
    if not found.is_file():
        raise OutputError(
            "rerun's viewer is not installed", where=str(found), hint="pip install --force-reinstall rerun-sdk"
        )
    return found


def find_recording(out: Path) -> Path:
    """The recording of a result folder, or the file itself; OutputError where there is none, or it is damaged."""
    file = out if out.is_file() else out / RECORDING
    if not out.exists():
        raise OutputError("there is no such result folder", where=str(out))
    if not file.is_file():
        hint = hint_below(out) or "run with output.recording=true, and name its result"
        raise OutputError("no recording here", where=str(out), hint=hint)
    check_recording(file)
    return file


def check_recording(file: Path) -> None:
    """Read a recording through; OutputError where it is none, cut off or damaged: the viewer would wait for the rest."""
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # no footer: a session still writes it, or was killed; what is there can be shown
            reader = RrdReader(file)
            for store in [*reader.recordings(), *reader.blueprints()]:
                for _ in reader.stream(store=store).to_chunks():
                    pass
        if not reader.recordings():
            raise ValueError("it is empty")
    except (RuntimeError, ValueError, OSError) as error:
        why = str(error).splitlines()[0].removeprefix(f"Failed to read RRD file at {file}: ")
        raise OutputError(f"the recording is damaged or cut off ({why})", where=str(file), hint="run again") from error


def free_port() -> int:
    """A port of the loopback interface that nobody listens on."""
    with socket.socket() as s:
        s.bind((LOOPBACK, 0))
        port: int = s.getsockname()[1]
        return port


def address(port: int) -> str:
    """Where a viewer of this machine takes data."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def web_address(web: int, port: int) -> str:
    """What to open in a browser: the page, and where it gets its data."""
    return f"http://{LOOPBACK}:{web}?url={address(port).replace('+', '%2B')}"


def start(*arguments: str, quiet: bool = True) -> subprocess.Popen[bytes]:
    """Start the viewer, bound to the loopback interface (by itself it listens to the whole network)."""
    environment = {**os.environ, "RUST_LOG": "error"} if quiet else dict(os.environ)
    return subprocess.Popen(
        [str(program()), "--bind", LOOPBACK, *arguments],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE if quiet else None,
    )


def show(files: list[Path]) -> None:
    """Open recordings in the native viewer and wait until it is closed; OutputError where it cannot open."""
    viewer = start("--port", str(free_port()), *map(str, files))
    _, said = _until_closed(viewer)
    if viewer.returncode not in (0, -15, -2):
        raise _failure(viewer.returncode, said, "use --web, or --screenshot FILE.png")


def serve(files: list[Path], say: Callable[[str], None]) -> None:
    """Serve recordings to a browser on this machine until interrupted; say(text) gets the address."""
    web, data = free_port(), free_port()
    viewer = start("--serve-web", "--web-viewer-port", str(web), "--port", str(data), *map(str, files))
    try:
        with suppress(KeyboardInterrupt):  # Ctrl+C is how serving ends
            wait_for(viewer, web)
            say(f"{web_address(web, data)} (Ctrl+C ends it)")
            _, said = _until_closed(viewer)
            raise _failure(viewer.returncode, said, None)
    finally:
        stop(viewer)


def screenshot(
    files: list[Path], picture: Path, size: tuple[int, int] = (1600, 900), at: float = 0.5, timeline: str = STAMP
) -> None:
    """A picture of the recordings as they look at first opening, without a screen.

    size: points, two pixels each. at: share of the timeline's length where the time stands.
    OutputError, in one line, where there is no Vulkan driver, or the picture cannot be written; ConfigError where its name
    does not end in .png.
    """
    if picture.suffix.lower() != ".png":
        raise ConfigError("a picture is a PNG", where=str(picture), hint="name it FILE.png")
    if not picture.parent.is_dir():
        raise OutputError("no such folder for the picture", where=str(picture.parent))
    temporary = picture.with_name(f".{picture.stem}.{os.getpid()}.png")
    port = free_port()
    window = f"{size[0]}x{size[1]}"
    viewer = start("--headless", "--hide-welcome-screen", "--port", str(port), "--window-size", window, *map(str, files))
    try:
        with _talking(viewer, port, files) as client:
            _stand(client, at, timeline)
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


@contextmanager
def _talking(viewer: subprocess.Popen[bytes], port: int, files: list[Path]) -> Iterator[ViewerClient]:
    """A connection to a viewer that has loaded what it was given."""
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _PATIENCE
    while True:
        if viewer.poll() is not None:
            _, said = viewer.communicate()
            raise _failure(viewer.returncode, said, None)
        try:
            client = ViewerClient.connect(address(port))
            state = client.get_state()
            if state.recordings and not state.loading and state.views:
                yield client
                return
        except (RuntimeError, ConnectionError, OSError):
            if time.monotonic() > end:
                raise
        if time.monotonic() > end:
            where = ", ".join(map(str, files))
            raise OutputError(f"the viewer has not loaded the recording in {_PATIENCE:g} s", where=where)
        time.sleep(0.1)


def _stand(client: ViewerClient, share: float, timeline: str) -> None:
    """Set the time to a share of a timeline, and stop it there."""
    state = client.get_state()
    recording = next((r for r in state.recordings if r.store_id == state.active_recording), state.recordings[0])
    lines = [t for t in recording.timelines if t.name == timeline]
    if not lines:
        return
    line = lines[0]
    start, end = line.start or 0, line.end or 0
    moment = round(start + share * (end - start))
    if line.time_type == "sequence":
        client.set_time(line.name, sequence=moment, play_state="paused")
    elif line.time_type == "timestamp":
        client.set_time(line.name, timestamp=np.datetime64(moment, "ns"), play_state="paused")
    else:
        client.set_time(line.name, duration=np.timedelta64(moment, "ns"), play_state="paused")


def _failure(code: int | None, said: bytes | None, hint: str | None) -> OutputError:
    """What a viewer that ended by itself says, in one line."""
    text = (said or b"").decode(errors="replace")
    if any(sign in text for sign in _NO_DRIVER):
        return OutputError(
            "the viewer finds no Vulkan driver to draw with",
            hint="Debian and Ubuntu: apt install libvulkan1 mesa-vulkan-drivers",
        )
    if any(sign in text for sign in _NO_SCREEN):
        return OutputError("the viewer finds no screen", hint=hint)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if "XDG_RUNTIME_DIR" not in line]  # said on every machine without a desktop
    panic = next((" ".join(lines[i : i + 2]) for i, line in enumerate(lines) if "panicked" in line), None)
    reason = panic or next((line for line in lines if "error" in line.lower()), lines[0] if lines else "")
    return OutputError(f"the viewer ended with code {code}" + (f": {reason[:200]}" if reason else ""), hint=hint)


def wait_for(viewer: subprocess.Popen[bytes], port: int) -> None:
    """Until a viewer listens on a port; OutputError where it ends instead."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        if viewer.poll() is not None:
            _, said = viewer.communicate()
            raise _failure(viewer.returncode, said, None)
        try:
            socket.create_connection((LOOPBACK, port), timeout=0.5).close()
            return
        except OSError:
            time.sleep(0.1)
    stop(viewer)
    raise OutputError("the viewer does not answer")


def let_go(viewer: subprocess.Popen[bytes]) -> None:
    """Let a viewer say what it likes from now on: nobody listens, and it must not wait for somebody who does."""
    if viewer.stderr is not None:
        threading.Thread(target=viewer.stderr.read, name="objslam viewer", daemon=True).start()


def _until_closed(viewer: subprocess.Popen[bytes]) -> tuple[bytes, bytes]:
    try:
        return viewer.communicate()
    except KeyboardInterrupt:
        stop(viewer)
        raise


def stop(viewer: subprocess.Popen[bytes]) -> None:
    """End a viewer that we started."""
    if viewer.poll() is None:
        viewer.terminate()
        try:
            viewer.wait(5.0)
        except subprocess.TimeoutExpired:
            viewer.kill()
            viewer.wait()
