"""The declaration of an export format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from objslam.output.export.content import Content


@dataclass(frozen=True)
class ExportFormat:
    """A format of `objslam export`. Each module in `formats` declares one format."""

    name: str  # The value of `--to`.
    file: str  # The usual name of the file in a result folder. A new run deletes the file with this name.
    help: str  # A short description for `--help`, without a full stop.
    dump: Callable[[Content], bytes]  # Returns the content of the file. Raises OutputError if the result lacks data.
    takes_datum: bool = False  # Whether the format uses `Content.datum`.
