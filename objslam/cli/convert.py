"""objslam convert: any source becomes a log folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import report, say
from objslam.cli.options import Anonymous, Format, Label, Robot, WithoutRange


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="What to read: UTIAS MRCLAM, TUM RGB-D with boxes, a log folder.")
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log folder to write.")],
    format_: Format = None,
    robot: Robot = None,
    without_range: WithoutRange = False,
    anonymous: Anonymous = False,
    label: Label = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log folder that is there.")] = False,
) -> None:
    """Write a data set as a log folder."""
    from objslam.ledger import Ledger
    from objslam.sources import SourceOptions, read
    from objslam.sources.folder import write_log_folder

    ledger = Ledger()
    options = SourceOptions(format_, robot, not without_range, anonymous, label)
    write_log_folder(read(source, ledger, options), log, overwrite=overwrite)
    report(ledger)
    say(f"wrote {log}")
