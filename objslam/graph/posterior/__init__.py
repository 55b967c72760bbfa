"""What a solved graph says beyond its solution.

The marginals tell how certain poses and landmarks are. The evidence tells how likely the measurements are, integrated over
all poses and landmarks.
"""
