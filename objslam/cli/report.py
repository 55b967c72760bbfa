"""objslam report: a result as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import progress_bar, say


def report_result(
    out: Annotated[Path, typer.Argument(help="A result folder.")],
    log: Annotated[
        Path | None,
        typer.Option("--log", help="The log, for the pictures; by default where it was when it was mapped."),
    ] = None,
    crops: Annotated[int, typer.Option("--crops", min=0, max=50, help="Pictures of each object.")] = 4,
) -> None:
    """Write report.html into a result folder: map, objects, residuals, evaluation, settings; one file, no network needed."""
    from objslam.output.report import write_report

    with progress_bar() as show:
        file = write_report(out, log=log, crops=crops, progress=show)
    say(f"wrote {file}")
