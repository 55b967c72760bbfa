"""Make recordings of runs, and of the proximity field of an object, for the rerun viewer. No other package imports rerun.

The view of a running session is in `viewer.live`. Colours and captions come from `plot`.
"""
