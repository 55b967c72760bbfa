"""CSV (RFC 4180): one line an object, for spreadsheets and data frames."""

from __future__ import annotations

import csv
import io
import math

from objslam.export.content import Content
from objslam.types import MapObject

COLUMNS = (
    *("id", "label", "status", "x", "y", "z", "cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
    *("rays", "frames", "parallax_deg", "rms_deg", "width", "height", "first_seen", "last_seen", "existence"),
)
"""Metres, m^2, degrees and seconds; empty where unknown."""
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def dump(content: Content) -> bytes:
    """The objects as UTF-8 text; every number reads back as the same float."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    writer.writerows(_row(o) for o in content.objects.objects)
    return text.getvalue().encode()


def _row(o: MapObject) -> list[object]:
    covariance = [None] * 6 if o.covariance is None else [float(o.covariance[i, j]) for i, j in _UPPER]
    width, height = o.extent or (None, None)
    seen = o.first_seen, o.last_seen, o.existence
    row = [o.id, o.label, o.status, *o.position.tolist(), *covariance, o.rays, o.frames, o.parallax_deg, o.rms_deg]
    return ["" if value is None or value != value or value in (math.inf, -math.inf) else value
            for value in (*row, width, height, *seen)]  # fmt: skip
