"""Make the report, one HTML page that shows a result folder. A reader can open the page offline, print it or send it.

`evaluation` computes the errors against the ground truth, and `plot` draws the picture of the map.
"""

from objslam.output.report.page import write_report

__all__ = ["write_report"]
