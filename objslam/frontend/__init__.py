"""From a log to measurements: keyframes on the path, bearing rays from boxes, ranges from depth, drift from odometry.

What a measurement is of is not asked here: that is `association`.
"""
