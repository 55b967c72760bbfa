"""Checks that compare parts of one log: single frames, and its two halves.

A recording of another day, or a camera that somebody moved, spoils only some parts.
"""
