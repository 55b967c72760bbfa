"""objslam export: a result in the format of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from objslam.cli.console import say


def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A result folder.")],
    to: Annotated[
        Literal["csv", "geojson", "ply", "g2o", "mcap"],
        typer.Option(
            "--to",
            help="csv: a table of objects. geojson: objects and path, for maps. ply: objects as points. g2o: poses and "
            "odometry, for other optimisers. mcap: map and path as ROS 2 messages, for Foxglove and RViz.",
        ),
    ],
    file: Annotated[
        Path | None, typer.Option("-o", "--out", help="The file to write. [default: objects.csv and so on, in OUT]")
    ] = None,
    datum: Annotated[
        str | None,
        typer.Option(
            "--datum",
            metavar="LAT,LON,HEADING",
            help="geojson: where the map's origin is (WGS 84, degrees) and where its x axis points (degrees clockwise from "
            "north). Without it, coordinates are metres in the map.",
        ),
    ] = None,
) -> None:
    """Write a result's map for other tools."""
    from objslam.export import export as write
    from objslam.export.datum import Datum

    say(f"wrote {write(out, to, file, None if datum is None else Datum.parse(datum))}")
