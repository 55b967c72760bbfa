"""objslam convert: any source becomes a log folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import report, say
from objslam.cli.options import (
    Anonymous,
    BaseFrame,
    CameraInfo,
    Format,
    Label,
    Rectified,
    Robot,
    Topics,
    WithoutRange,
    source_options,
)


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="What to read: a ROS bag, UTIAS MRCLAM, TUM RGB-D, a log folder.")
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log folder to write.")],
    format_: Format = None,
    robot: Robot = None,
    without_range: WithoutRange = False,
    anonymous: Anonymous = False,
    label: Label = None,
    topic: Topics = None,
    camera_info: CameraInfo = None,
    base_frame: BaseFrame = None,
    rectified: Rectified = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log folder that is there.")] = False,
) -> None:
    """Write a recording as a log folder, its images and depth images too."""
    from objslam.ledger import Ledger
    from objslam.sources import convert

    ledger = Ledger()
    options = source_options(format_, robot, without_range, anonymous, label, topic, camera_info, base_frame, rectified)
    convert(source, log, ledger, options, overwrite=overwrite)
    report(ledger)
    say(f"wrote {log}")
