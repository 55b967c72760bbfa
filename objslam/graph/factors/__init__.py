"""Turn measurements into GTSAM factors, with one file for each kind of factor, for offline and live use.

Which measurements enter a graph is decided in `graph/assembly.py` offline, and by the callers of `graph/isam2.py` live.
"""
