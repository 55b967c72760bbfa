"""Checks of parts of one log: single frames, its two halves, and times in which the poses stand still.

A recording of another day, or a camera that somebody moved, spoils only some parts.
"""
