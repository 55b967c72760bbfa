"""Hypotheses about wrong input: changes that would correct a log, and the test of how well each explains it.

`every` yields all hypotheses, and `mounts` only hypotheses about the mounts of cameras. `trials` tests them and names the
best.
"""
