"""The command `objslam export`, which writes a result in the format of another tool."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import say
from objslam.output.export.formats import FORMATS

_HELP = " ".join(f"{known.name}: {known.help}." for known in FORMATS.values())
_DATUM_HELP = (
    f"{', '.join(known.name for known in FORMATS.values() if known.takes_datum)}: latitude and longitude of the map origin "
    "(WGS 84, degrees), and heading of the x axis (degrees clockwise of north). Without --datum: m in the frame of the map."
)


def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A result folder.")],
    to: Annotated[str, typer.Option("--to", metavar="|".join(FORMATS), help=_HELP)],
    file: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="The file to write, - for stdout. Default: the usual file name of the format, in OUT."
        ),
    ] = None,
    datum: Annotated[str | None, typer.Option("--datum", metavar="LAT,LON,HEADING", help=_DATUM_HELP)] = None,
) -> None:
    """Write the map of a result in the format of another tool."""
    from objslam.output.export import dump_export, write_export
    from objslam.output.export.content import Datum

    place = None if datum is None else Datum.parse(datum)
    if file == Path("-"):
        sys.stdout.buffer.write(dump_export(out, to, place))
        return
    say(f"wrote {write_export(out, to, file, place)}")
