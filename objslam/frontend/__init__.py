"""Turn a log into measurements: keyframes on the path, bearing rays from boxes, ranges from depth, drift from odometry.

The package `association` decides which object a measurement belongs to.
"""
