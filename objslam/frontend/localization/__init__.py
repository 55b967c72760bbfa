"""What a localisation measured: its jumps, its gaps, and which of its poses are measurements.

The noise of a localisation, and the factors of the graph for its poses, are in `graph`.
"""
