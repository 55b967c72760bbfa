"""The view of a running session: a separate process that logs to the viewer, and the messages to this process.

The recording of a finished run is made in `viewer`.
"""
