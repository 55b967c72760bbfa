"""The report: a result folder as one HTML page that needs no network, to read, to print, to send to somebody."""

from __future__ import annotations

from objslam.report.page import write_report

__all__ = ["write_report"]
