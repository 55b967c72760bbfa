"""What a module in `formats` declares of its format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from objslam.output.export.content import Content


@dataclass(frozen=True)
class ExportFormat:
    """One format of `objslam export`."""

    name: str  # What `--to` takes.
    file: str  # The usual name of the file in a result folder; a new run removes the file of that name.
    help: str  # A few words for `--help`, without a full stop.
    dump: Callable[[Content], bytes]  # The content of the file; OutputError where the result lacks what the format needs.
    takes_datum: bool = False  # Whether `Content.datum` has a meaning for the format.
