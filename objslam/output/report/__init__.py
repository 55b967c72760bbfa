"""The report: one HTML page that shows a result folder, and that a reader can open offline, print or send.

The errors against the ground truth are computed in `evaluation`, and the picture of the map is drawn in `plot`.
"""

from objslam.output.report.page import write_report

__all__ = ["write_report"]
