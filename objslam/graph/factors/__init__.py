"""Turn measurements into GTSAM factors, with one file for each kind of factor, for offline and live use.

`graph/assembly.py` decides offline which measurements enter a graph. Live, the callers of `graph/isam2.py` decide.
"""
