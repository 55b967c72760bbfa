"""objslam view: open a result in the viewer."""

from __future__ import annotations

import signal
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import say


def view(
    out: Annotated[Path, typer.Argument(help="A result folder, or a recording (.rrd).")],
    object_: Annotated[
        int | None,
        typer.Option("--object", help="Show the proximity field of the object with this id, and what pulls on it."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser on this machine instead of opening a window.")
    ] = False,
    screenshot: Annotated[
        Path | None, typer.Option("--screenshot", metavar="FILE.png", help="Write a picture instead; needs no screen.")
    ] = None,
    at: Annotated[float, typer.Option("--at", min=0.0, max=1.0, help="For a picture: when, as a share of the drive.")] = 0.5,
) -> None:
    """Look at a result: the drive, its objects, and how they came about."""
    from objslam.errors import ConfigError
    from objslam.output.viewer import application

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the viewer must not outlive us
    if web and screenshot is not None:
        raise ConfigError("--web and --screenshot at a time")
    with tempfile.TemporaryDirectory(prefix="objslam-view-") as folder:
        if object_ is None:
            recording = application.find_rrd(out)
        else:
            from objslam.output.viewer.field import write_field

            recording = Path(folder) / "field.rrd"
            write_field(out, object_, recording)
        if screenshot is not None:
            application.screenshot([recording], screenshot, at=at)
            say(f"wrote {screenshot}")
        elif web:
            application.serve([recording], say)
        else:
            application.show([recording])
