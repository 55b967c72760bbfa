"""One file for each kind of factor: it knows its measurement and makes GTSAM's factors of it, the same offline and live.

Which measurements go into a graph is not said here: offline `graph/assembly.py` does, live the callers of `graph/isam2.py`.
"""
