"""The command `objslam live`: its options, the loop that runs until the session ends, and the status line.

The session itself is in `objslam.live`.
"""
