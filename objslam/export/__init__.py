"""Exports: a result in the formats of other tools, one file each. `FORMATS` is the table of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from objslam.atomic_files import write_file
from objslam.errors import ConfigError, OutputError
from objslam.export import csv_file, g2o_file, geojson_file, mcap_file, ply_file
from objslam.export.content import Content, load_content
from objslam.export.datum import Datum

Format = Literal["csv", "geojson", "ply", "g2o", "mcap"]


@dataclass(frozen=True)
class Exporter:
    """A format: the name of the file, and what makes its content."""

    file: str
    dump: Callable[[Content, Datum | None], bytes]


FORMATS: dict[Format, Exporter] = {
    "csv": Exporter("objects.csv", lambda content, datum: csv_file.dump(content)),
    "geojson": Exporter("objects.geojson", geojson_file.dump),
    "ply": Exporter("objects.ply", lambda content, datum: ply_file.dump(content)),
    "g2o": Exporter("graph.g2o", lambda content, datum: g2o_file.dump(content)),
    "mcap": Exporter("map.mcap", lambda content, datum: mcap_file.dump(content)),
}


def export(out: Path, to: Format, file: Path | None = None, datum: Datum | None = None) -> Path:
    """Write the result in the folder `out` in a format, into `file` or, by its usual name, into that folder.

    Returns the path of the file. datum: where the map lies on the earth, for GeoJSON; ConfigError with any other format.
    OutputError where the result cannot be read, has not what the format needs, or the file cannot be written.
    """
    if datum is not None and to != "geojson":
        raise ConfigError(f"a datum has no meaning for {to}", hint="--datum goes with --to geojson")
    file = file or out / FORMATS[to].file
    if file.is_dir():
        raise OutputError("a folder stands where the file goes", where=str(file))
    write_file(file, FORMATS[to].dump(load_content(out), datum))
    return file
