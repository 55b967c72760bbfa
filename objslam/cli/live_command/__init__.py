"""The command `objslam live`: its options, the loop of a session until it ends, and the line that shows its state.

The session itself is in `objslam.live`.
"""
