"""The Python interface. It reads or makes a log, maps a log, pushes data into a session, and queries the result.

`import objslam` offers the public names, and imports each name at its first use. Warnings go to the logger `objslam`.
"""
