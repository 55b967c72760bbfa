"""objslam convert: any source becomes a log folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import report, say
from objslam.cli.options import with_options
from objslam.sources import SourceOptions


@with_options
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="What to read: a ROS bag, UTIAS MRCLAM, TUM RGB-D, a log folder.")
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log folder to write.")],
    *,
    options: SourceOptions,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log folder that is there.")] = False,
) -> None:
    """Write a recording as a log folder, its images and depth images too."""
    from objslam.core.diagnostics import Ledger
    from objslam.sources import convert

    ledger = Ledger()
    convert(source, log, ledger, options, overwrite=overwrite)
    report(ledger)
    say(f"wrote {log}")
