"""The Python interface: read or make a log, map it, push data into a session, and query the result.

`import objslam` offers the public names, and imports each at its first use. Warnings go to the logger `objslam`.
"""
