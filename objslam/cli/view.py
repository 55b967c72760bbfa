"""The command `objslam view`, which opens a result in the viewer."""

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
        typer.Option("--object", help="Show the proximity field of the object with this id, and the rays that attract it."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the viewer to a browser on this machine, without a window.")
    ] = False,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE.png", help="Write a picture and open no viewer. This needs no display."),
    ] = None,
    at: Annotated[
        float, typer.Option("--at", min=0.0, max=1.0, help="Time of the picture as a share of the drive, from 0 to 1.")
    ] = 0.5,
) -> None:
    """Show the drive and the objects of a result in the viewer."""
    from objslam.errors import ConfigError
    from objslam.output.viewer import application

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM then ends the viewer together with this process.
    if web and screenshot is not None:
        raise ConfigError("--web and --screenshot cannot be combined", hint="leave out one of them")
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
