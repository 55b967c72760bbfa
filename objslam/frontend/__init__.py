"""Turn a log into measurements: keyframes on the path, bearing rays from boxes, ranges from depth, drift from odometry.

Which object a measurement belongs to is decided in `association`.
"""
