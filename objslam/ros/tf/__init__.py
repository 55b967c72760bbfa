"""Look up transforms between named frames over time, in a tree for a recording and in a buffer for a live session.

The decoding of transform messages is in `ros.messages`.
"""
