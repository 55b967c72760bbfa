"""The report: a result folder as one HTML page that needs no network, to read, to print, to send to somebody.

Errors against a truth are computed in `evaluation`; the map's picture comes from `plot`.
"""

from __future__ import annotations

from objslam.output.report.page import write_report

__all__ = ["write_report"]
