"""The CSV format (RFC 4180) for spreadsheets and data frames. Each object is one line."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Any

from objslam.errors import printable
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.output.export.content import Content

_FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""The characters that start a formula in a spreadsheet. The last four are the full-width forms of the first four."""


def _dump(content: Content) -> bytes:
    """Return the objects as UTF-8 text. Objects that are gone come last. Numbers have all digits of their floats.

    The cell of an unknown value is empty. A label that a spreadsheet would take for a formula gets an apostrophe in front.
    OWASP advises this against CSV injection.
    """
    from objslam.core.object_map import COLUMNS

    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    writer.writerows([_cell(value) for value in o.row().values()] for o in (*content.objects, *content.objects.gone))
    return text.getvalue().encode()


def _cell(value: Any) -> Any:
    if not isinstance(value, str):
        return "" if value is None else value
    text = printable(value)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


EXPORT = ExportFormat("csv", "objects.csv", "a table of objects", _dump)
