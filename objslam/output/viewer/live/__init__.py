"""Show a running session. A separate process logs to the viewer, and the session sends messages to this process.

`viewer` makes the recording of a finished run.
"""
