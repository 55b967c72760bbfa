"""The CSV format (RFC 4180): one line per object, for spreadsheets and data frames."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.output.export.content import Content


def _dump(content: Content) -> bytes:
    """Return the objects as UTF-8 text. A reader gets each number back as the same float. An unknown value is empty."""
    from objslam.core.object_map import COLUMNS

    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    writer.writerows(["" if value is None else value for value in o.row().values()] for o in content.objects)
    return text.getvalue().encode()


EXPORT = ExportFormat("csv", "objects.csv", "a table of objects", _dump)
