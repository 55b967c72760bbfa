"""A session in the viewer while it runs: a process of its own that draws it, and the messages to that process.

What a finished run shows is in `viewer` itself.
"""
