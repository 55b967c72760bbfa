"""The CSV format (RFC 4180): one line per object, for spreadsheets and data frames."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING

from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.core.object_map import MapObject
    from objslam.output.export.content import Content

_COLUMNS = (
    *("id", "label", "status", "x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("rays", "frames", "parallax_deg", "rms_deg", "width", "height", "first_seen", "last_seen", "existence"),
)
"""The columns: positions and sizes are in m, covariances in m^2, and stamps in s. The cell of an unknown value is empty."""
_UPPER_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # The rows and columns of the covariance values.


def _dump(content: Content) -> bytes:
    """Return the objects as UTF-8 text. A reader gets each number back as the same float."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(_COLUMNS)
    writer.writerows(_row(o) for o in content.objects.objects)
    return text.getvalue().encode()


def _row(o: MapObject) -> list[object]:
    covariance = [None] * 6 if o.covariance is None else [float(o.covariance[at]) for at in _UPPER_TRIANGLE]
    row = (
        *(o.id, o.label, o.status, *o.position.tolist(), *covariance, o.rays, o.frames, o.parallax_deg, o.rms_deg),
        *(*(o.extent or (None, None)), o.first_seen, o.last_seen, o.existence),
    )
    return ["" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value for value in row]


EXPORT = ExportFormat("csv", "objects.csv", "a table of objects", _dump)
