"""Transforms between named frames over time: a tree of a whole recording, and a buffer of what has come so far.

The messages that carry them are decoded in `ros.messages`.
"""
