"""What rerun shows: recordings of runs, the proximity field of an object. The only room that knows rerun.

A session that is still running is shown by `viewer.live`; colours and labels are those of `plot`.
"""
