"""The Python interface: read or make a log, map it, push data into a session, and query the result.

`import objslam` offers all names of this room. They are imported at their first use. Warnings go to the logger `objslam`.
"""
