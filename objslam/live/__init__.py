"""Live: the map of a running robot, which is shown and published while it grows.

The offline driver for a complete log is in `mapping`; this folder uses the same rooms below it.
"""
