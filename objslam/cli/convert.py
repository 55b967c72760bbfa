"""The command `objslam convert`, which writes a recording as a log folder."""

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import progress_bar, report, say
from objslam.cli.options import with_options
from objslam.sources import SourceOptions


@with_options
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="The recording, such as a ROS bag. `objslam info` tells its kind.")
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log folder to write.")],
    *,
    options: SourceOptions,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing log folder.")] = False,
) -> None:
    """Write a recording as a log folder, including its images and depth images."""
    from objslam.core.diagnostics import Ledger
    from objslam.sources import convert

    ledger = Ledger()
    with progress_bar() as show:
        show("converting", 0, 0)
        convert(source, log, ledger, options, overwrite=overwrite)
    report(ledger)
    say(f"wrote {log}")
