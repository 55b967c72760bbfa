"""Export a result to the file formats of other tools. `formats` has one module for each format.

The packages `plot`, `viewer` and `report` make pictures, recordings and reports.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from objslam.errors import ConfigError, OutputError
from objslam.output.export.formats import FORMATS

if TYPE_CHECKING:
    from objslam.output.export.content import Datum
    from objslam.output.export.export_format import ExportFormat


def write_export(out: Path, to: str, file: Path | None = None, datum: Datum | None = None) -> Path:
    """Write the result in the folder `out` in another tool's format and return the path of the file.

    Args:
        to: the name of a format in `FORMATS`.
        file: the file to write. The default is the format's usual file in `out`.
        datum: the position of the map on the earth, None if it is unknown.
    Raises:
        ConfigError: the format does not exist, or it cannot use the given datum.
        OutputError: the result cannot be read or lacks data that the format needs, or the file cannot be written.
    """
    from objslam.io.atomic_files import write_file

    file = file or out / _chosen(to, datum).file
    if file.is_dir():
        raise OutputError("the file cannot be written, because a folder has its name", where=str(file))
    write_file(file, dump_export(out, to, datum))
    return file


def dump_export(out: Path, to: str, datum: Datum | None = None) -> bytes:
    """Return the content of the file that `write_export` writes. Raises the same errors as `write_export`."""
    from objslam.output.export.content import load_content

    return _chosen(to, datum).dump(load_content(out, datum))


def _chosen(to: str, datum: Datum | None) -> ExportFormat:
    if to not in FORMATS:
        raise ConfigError(f"there is no export format {to!r}", hint=f"--to takes {', '.join(FORMATS)}")
    chosen = FORMATS[to]
    if datum is not None and not chosen.takes_datum:
        takers = " or ".join(f"--to {other.name}" for other in FORMATS.values() if other.takes_datum)
        raise ConfigError(f"a datum has no meaning for {to}", hint=f"--datum goes with {takers}")
    return chosen
