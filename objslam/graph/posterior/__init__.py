"""What a solved graph says beyond its solution.

The marginals show how certain poses and landmarks are. The evidence says how likely the measurements are, integrated over
all poses and landmarks.
"""
