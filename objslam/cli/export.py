"""objslam export: a result in the format of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import say
from objslam.output.export.formats import FORMATS


def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A result folder.")],
    to: Annotated[
        str,
        typer.Option(
            "--to", metavar="|".join(FORMATS), help=" ".join(f"{known.name}: {known.help}." for known in FORMATS.values())
        ),
    ],
    file: Annotated[
        Path | None, typer.Option("-o", "--out", help="The file to write; by default the format's usual file, in OUT.")
    ] = None,
    datum: Annotated[
        str | None,
        typer.Option(
            "--datum",
            metavar="LAT,LON,HEADING",
            help=f"{', '.join(known.name for known in FORMATS.values() if known.takes_datum)}: where the map's origin is "
            "(WGS 84, degrees) and where its x axis points (degrees clockwise from north). Without it, coordinates are "
            "metres in the map.",
        ),
    ] = None,
) -> None:
    """Write a result's map for other tools."""
    from objslam.output.export import write_export
    from objslam.output.export.content import Datum

    say(f"wrote {write_export(out, to, file, None if datum is None else Datum.parse(datum))}")
