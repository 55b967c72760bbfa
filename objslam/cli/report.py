"""The command `objslam report`, which writes a result as one HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import progress_bar, put, say
from objslam.cli.options import Json, Quiet


def report_result(
    out: Annotated[Path, typer.Argument(help="A result folder.")],
    log: Annotated[
        Path | None, typer.Option("--log", help="The log with the images. Default: the log that the run read.")
    ] = None,
    crops: Annotated[
        int, typer.Option("--crops", min=0, max=50, help="Number of image crops of an object: its best boxes.")
    ] = 4,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Write report.html with the map in 3D, objects, residuals, evaluation and settings of a result. It works offline.

    The page of a site shows its sessions, and what became of each object.
    """
    from objslam.io.results.files import dump_json
    from objslam.output.report import write_report

    with progress_bar(quiet=quiet) as show:
        # A user who names a log wants its images. A page without images must not replace a page with images.
        file = write_report(out, log=log, crops=crops, images_needed=log is not None, progress=show)
    if json and not quiet:
        put(dump_json({"wrote": str(file)}))
    elif not quiet:
        say(f"wrote {file}")
