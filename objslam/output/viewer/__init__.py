"""Recordings of runs, and of the proximity field of an object, for the rerun viewer. No other folder imports rerun.

The view of a running session is in `viewer.live`, and colours and captions come from `plot`.
"""
