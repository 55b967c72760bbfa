"""What a localisation measured: its jumps, its gaps, and which of its poses are measurements.

The noise of a localisation and its factors do not live here. They are in `graph`.
"""
